"""The picture of the page on exported FMUs: what a tool makes of an input that it holds.

The FMU is simulated in co-simulation at two communication steps, and for comparison in model
exchange, where the input is linear between its samples, as in a run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from docs.svg import Axes, document, text

import cluster_est as ce
from workers.messages import FloatArray
from workers.messages.types import Interface

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "configs" / "mass_spring_damper.toml"
FMU = ROOT / "configs" / "models" / "mass_spring_damper.fmu"
TRUE = {"m": 1.2, "k": 30.0, "c": 0.6}
"""The values that made the measurements."""
LARGE, SMALL = 0.1, 0.02
"""Communication steps in seconds; the samples are 0.02 s apart."""
FROM, TO = 4.0, 6.4
"""What is shown, in seconds; all of the experiment counts in the numbers."""
WIDTH, HEIGHT = 860, 600

STYLE = """
.sample { stroke: var(--ink); stroke-width: 3.4; stroke-linecap: round; fill: none; }
.thin { stroke-width: 1.3; fill: none; }
.run { stroke: var(--ink); stroke-width: 1.4; fill: none; }
.dot { stroke-width: 5; stroke-linecap: round; fill: none; }
"""


@dataclass(frozen=True)
class HeldInputSimulation:
    """A simulation whose input is held within each communication step.

    Attributes
    ----------
    times
        Communication points in seconds.
    force, position
        What the FMU was given there, and what its output is there.
    off
        Of the position from that of the run, at the same times.
    """

    times: FloatArray
    force: FloatArray
    position: FloatArray
    off: FloatArray

    @property
    def rms(self) -> float:
        """The root mean square of `off`."""
        return float(np.sqrt(np.mean(self.off**2)))


def picture() -> str:
    """The input, the output and its error at two communication steps as SVG."""
    large, small = held(LARGE), held(SMALL)
    force = experiment().inputs[0]
    run = reference()
    upper = Axes(64, 836, 92, 230, (FROM, TO), (-5.6, 5.6))
    middle = Axes(64, 836, 270, 408, (FROM, TO), (-0.3, 0.3))
    lower = Axes(64, 836, 448, 556, (FROM, TO), (-0.1, 0.1))
    seconds = f"{reference().times[-1]:.0f} s"
    rms = f"{large.rms:.4f} with {LARGE:g} s, {small.rms:.4f} with {SMALL:g} s"
    parts = [
        text(
            24,
            28,
            "An input that is held within each step acts half a step late on average",
            "head",
        ),
        *_legend(54),
        text(64, 82, "force in N, as the FMU gets it"),
        *upper.rules((-5.0, 0.0, 5.0)),
        *(
            upper.stairs(*_shown(each.times, each.force), kind)
            for each, kind in ((small, "thin c0"), (large, "line c1"))
        ),
        upper.dots(*_shown(force.times, force.values), "sample"),
        text(64, 260, "position in m, at the communication points"),
        *middle.rules((-0.2, 0.0, 0.2)),
        *_both(middle, large, large.position, small, small.position),
        middle.curve(*_shown(run.times, run.values), "run"),
        text(64, 438, f"difference from the run in m; its root mean square over {seconds}: {rms}"),
        *lower.rules((-0.1, 0.0, 0.1)),
        *_both(lower, large, large.off, small, small.off),
        *lower.numbers(FROM + 0.4 * np.arange(7)),
        text(836, HEIGHT - 10, "time in s", anchor="end"),
    ]
    title = "An input that is held within each communication step, and what it does to the output"
    return document((WIDTH, HEIGHT), title, STYLE, parts)


def experiment() -> ce.Experiment:
    """The measured experiment whose force is used."""
    return ce.read_problem(CONFIG).experiments[0]


def reference() -> ce.Output:
    """The position of a run: in model exchange, the force linear between its samples."""
    return _simulated(experiment(), "model_exchange", ce.Solver("dormand_prince"))


def held(step: float) -> HeldInputSimulation:
    """The same in a tool that sets the force at each communication point and then holds it."""
    measured = experiment()
    (force,), (position,) = measured.inputs, measured.outputs
    every = round(step / float(force.times[1] - force.times[0]))
    times, values = force.times[::every], force.values[::every]
    given = replace(
        measured,
        inputs=(ce.Input(force.variable, times, values, "hold"),),
        outputs=(replace(position, times=times, values=position.values[::every]),),
        stop=float(times[-1]),
    )
    found = _simulated(given, "co_simulation", ce.Solver("fmu", step=step))
    return HeldInputSimulation(
        times, values, found.values, found.values - reference().values[::every]
    )


def _simulated(measured: ce.Experiment, interface: Interface, solver: ce.Solver) -> ce.Output:
    """The output of an experiment, simulated at its measured times."""
    problem = ce.read_problem(CONFIG)
    model = ce.read_model(FMU, interface=interface, solver=solver)
    problem = replace(problem, model=model, experiments=(measured,))
    (simulation,) = ce.simulate(problem, values=TRUE).values()
    trajectory = simulation.outcome.trajectory
    if trajectory is None:
        raise RuntimeError(simulation.outcome.message)
    (output,) = measured.outputs
    rows = np.searchsorted(trajectory.times, output.times)
    column = trajectory.variables.index(output.variable)
    return replace(output, values=trajectory.values[rows, column])


def _shown(times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    inside = (times >= FROM - 1e-9) & (times <= TO + 1e-9)
    return times[inside], values[inside]


def _both(
    axes: Axes,
    large: HeldInputSimulation,
    at_large: FloatArray,
    small: HeldInputSimulation,
    at_small: FloatArray,
) -> list[str]:
    """A curve for each step; dots at the communication points where they can be told apart."""
    return [
        axes.curve(*_shown(small.times, at_small), "line c0"),
        axes.curve(*_shown(large.times, at_large), "line c1"),
        axes.dots(*_shown(large.times, at_large), "dot c1"),
    ]


def _legend(y: float) -> list[str]:
    """What the curves are."""
    return [
        f'<path class="sample" d="M64 {y - 4}h0m8 0h0m8 0h0"/>',
        text(90, y, "samples"),
        f'<path class="run" d="M170 {y - 4}h22"/>',
        text(198, y, "run: linear between samples"),
        f'<path class="line c0" d="M396 {y - 4}h22"/>',
        text(424, y, f"communication step of {SMALL:g} s"),
        f'<path class="line c1" d="M620 {y - 4}h22"/>',
        text(648, y, f"communication step of {LARGE:g} s"),
    ]
