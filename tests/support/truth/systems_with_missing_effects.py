"""Example FMUs in experiments that a closed loop looks at; what is measured is given or zero."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from support.problems.springs import ROOT

from cluster_est import Experiment, Input, Model, Output, Parameter, Problem, Solver
from cluster_est.closed_loop.fitter import FitStart, FittedModel
from cluster_est.closed_loop.settings import LoopSettings, LoopStage
from cluster_est.closed_loop.workbench import LoopRequest, LoopWorkbench, open_workbench
from workers.messages import FloatArray


@dataclass(frozen=True)
class System:
    """An FMU with sensible parameters, and how it is driven: offset + swing * waves.

    Inputs that are driven `beside` take waves of another phase.
    """

    parameters: dict[str, float]
    drive: str
    outputs: tuple[str, ...]
    stop: float
    step: float
    offset: float
    swing: float
    values: tuple[tuple[str, float], ...] = ()
    beside: tuple[str, ...] = ()
    folder: str = "configs/models"


SYSTEMS = {
    "mass_spring_damper": System(
        {"m": 1.2, "k": 30.0, "c": 0.6}, "F", ("y",), 6.0, 0.01, 0.0, 4.0, (("x", 0.1),)
    ),
    "pendulum": System(
        {"J": 0.1, "G": 2.0, "b": 0.04}, "torque", ("y",), 6.0, 0.01, 0.0, 0.8, (("angle", 0.5),)
    ),
    "cascaded_tanks": System(
        {"k1": 0.05, "k2": 0.05, "kp": 0.05}, "u", ("y",), 300.0, 0.5, 4.0, 1.5
    ),
    "two_mass_drive": System(
        {"J_motor": 0.02, "J_load": 0.05, "k_shaft": 20.0, "d_shaft": 0.05, "b_motor": 0.01,
         "b_load": 0.05},
        "torque", ("motor_speed", "load_speed"), 3.0, 0.005, 0.0, 1.0,
    ),
    "gantry_crane": System(
        {"m_trolley": 6.0, "m_load": 2.0, "l_rope": 0.8, "b_trolley": 8.0, "d_pivot": 0.05},
        "F", ("position", "angle"), 6.0, 0.01, 0.0, 12.0, (("phi", 0.2),),
    ),
    "kiln": System(
        {"C_plate": 400.0, "C_charge": 900.0, "G_between": 6.0, "G_plate": 2.5, "G_charge": 1.2},
        "power", ("plate", "charge"), 3000.0, 10.0, 950.0, 400.0,
    ),
    "battery": System(
        {"Q": 7200.0, "R0": 0.05, "R1": 0.03, "C1": 3000.0},
        "current", ("voltage",), 2000.0, 10.0, 0.5, 1.5,
    ),
    # without states: a motion is given, and the current that it needs is measured
    "ur5e": System(
        {"J": 0.2, "Fv": 0.3}, "qd", ("i",), 10.0, 0.02, 0.0, 0.6, beside=("qdd",),
        folder="configs/league/models",
    ),
}  # fmt: skip


def waves(times: FloatArray, phase: float) -> FloatArray:
    """Three incommensurate sines over the whole record, at most 1.9."""
    u = 2.0 * np.pi * times / times[-1]
    slow, middle = np.sin(2.3 * u + phase), 0.6 * np.sin(5.1 * u + 2.0 * phase)
    return np.asarray(slow + middle + 0.3 * np.sin(11.7 * u - phase))


def missing_effect_problem(
    name: str,
    experiments: int = 2,
    interface: str = "model_exchange",
    signals: tuple[str, ...] = ("extra",),
    local: Sequence[str] = (),
) -> Problem:
    """Experiments of different amplitude; `local` parameters have a value for each of them."""
    system = SYSTEMS[name]
    times = np.arange(0.0, system.stop + 0.5 * system.step, system.step)
    runs = []
    for e in range(experiments):
        swing = system.swing * (1.0 + 0.4 * e)
        given = tuple(
            Input(name, times, system.offset + swing * waves(times, e + 1.7 * i))
            for i, name in enumerate((system.drive, *system.beside))
        )
        seen = tuple(
            Output(name, times, np.zeros(len(times)), 0.5 + 0.2 * i)
            for i, name in enumerate(system.outputs)
        )
        more = tuple(Input(s, times, waves(times, 0.5 - e)) for s in signals)
        last = float(times[-1])
        runs.append(Experiment(f"e{e}", 0.0, last, given, seen, system.values, signals=more))
    parameters = tuple(
        Parameter(n, v, (v / 10.0, v * 10.0), per="experiment" if n in local else None)
        for n, v in system.parameters.items()
    )
    path = ROOT / system.folder / f"{name}.fmu"
    solver = Solver("dormand_prince", rtol=1e-9)
    if interface == "co_simulation":
        solver = Solver("fmu")
    model = Model(path.name, path.read_bytes(), interface, solver, tuple(system.parameters))  # type: ignore[arg-type]
    return Problem(model, parameters, tuple(runs))


@contextmanager
def opened(problem: Problem, settings: LoopSettings | None = None) -> Iterator[LoopWorkbench]:
    """A workbench with one local worker."""
    request = LoopRequest(problem, settings=settings or LoopSettings())
    with open_workbench(request) as bench:
        yield bench


def unfitted(bench: LoopWorkbench, start: FitStart | None = None) -> FittedModel:
    """The model where it starts, as if it had been fitted; its Jacobian is zero."""
    space = bench.fitter.space(start or FitStart(bench.fitter.problem, {}))
    ((at,),) = bench.fitter.evaluate(LoopStage.TRIALS, [(space, space.start[None, :])])
    assert at.ok, at.reason
    return FittedModel(space, space.start, at.residuals, np.zeros((bench.fitter.size, space.size)))


def measured(problem: Problem, noise: float, seed: int = 3) -> Problem:
    """With what the model itself gives at the start of its parameters, and white noise."""
    generator = np.random.default_rng(seed)
    with opened(problem) as bench:
        residuals = unfitted(bench).residuals
    runs, first = [], 0
    for run in problem.experiments:
        outputs = []
        for output in run.outputs:
            part = residuals[first : first + len(output.times)]
            first += len(part)
            values = output.values - output.sigma * part
            outputs.append(
                replace(output, values=values + noise * generator.normal(size=len(part)))
            )
        runs.append(replace(run, outputs=tuple(outputs)))
    return replace(problem, experiments=tuple(runs))


def started(problem: Problem, **starts: float) -> Problem:
    """With other starts of some parameters."""
    parameters = tuple(replace(p, start=starts.get(p.name, p.start)) for p in problem.parameters)
    return replace(problem, parameters=parameters)
