"""The communication step at which the exported FMU has the error reported by the run.

Many tools keep an FMU's inputs constant between two communication points. An input that was linear
between its samples in the run then becomes a staircase, and the error increases with the step. This
module measures the error by simulating the exported FMU in the same way.
"""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.errors import ClusterEstError
from cluster_est.model_export.repaired_model import RepairedModel
from cluster_est.results.output_errors import output_residuals
from workers.evaluate import Evaluator
from workers.fmu.xml import XML
from workers.messages import Experiment, Model, Solver, Task
from workers.wire import TaskBatch

HALVINGS = 7
"""Largest number of times that the step is halved."""
SAME_STEP_ERROR = 0.01
"""Relative difference from the reported error below which errors count as equal."""
NEGLIGIBLE_DIFFERENCE = 1e-6
"""Difference, as a share of a measured signal's standard deviation, that counts as zero."""
MOST_STEPS = 4_000_000
"""Largest number of communication steps in all simulations at one step; they take some seconds."""

Errors = dict[str, float]
"""Root mean square error of each output, in its unit."""
ErrorPairs = tuple[tuple[str, float], ...]
"""Root mean square error of each output as hashable pairs of name and error."""


@dataclass(frozen=True)
class StepErrors:
    """The errors of the exported FMU at several communication steps, and those of the run.

    Attributes
    ----------
    experiments
        Ids of the simulated experiments.
    units
        Units of the outputs.
    reported
        Errors of the run for the same experiments.
    measured
        (step in seconds, errors); each step is half of the previous one.
    reproduces
        The first step with the errors of the run; None if there is none.
    why_not
        The reason why nothing was measured, as a sentence; empty if it was.
    """

    experiments: tuple[str, ...] = ()
    units: tuple[tuple[str, str], ...] = ()
    reported: ErrorPairs = ()
    measured: tuple[tuple[float, ErrorPairs], ...] = ()
    reproduces: float | None = None
    why_not: str = ""

    @property
    def sentence(self) -> str:
        """A sentence for the user about the communication step of the exported FMU."""
        if self.why_not:
            return f"the error at different communication steps was not measured: {self.why_not}"
        first, at_first = self.measured[0]
        run = _text(self.reported, self.units)
        held = "a tool that keeps inputs constant within a communication step"
        if self.reproduces is None:
            last, at_last = self.measured[-1]
            return (
                f"{held} does not reproduce the run's RMSE ({run}): with steps of {last:.6g} s, "
                f"the smallest that were tried, the RMSE is {_text(at_last, self.units)}; set "
                "input derivatives, or simulate by model exchange"
            )
        step = f"a communication step of {self.reproduces:.6g} s reproduces the run's RMSE ({run})"
        if self.reproduces == first:
            return step
        return (
            f"{step} in a tool that keeps inputs constant within a step; with {first:.6g} s, the "
            f"RMSE is {_text(at_first, self.units)}"
        )


def _text(errors: ErrorPairs, units: tuple[tuple[str, str], ...]) -> str:
    of = dict(units)
    return ", ".join(f"{name}: {value:.4g} {of[name]}".rstrip() for name, value in errors)


def measure_step(repair: RepairedModel, archive: bytes) -> StepErrors:
    """Simulate the exported FMU with decreasing steps until the error is that of the run.

    Parameters
    ----------
    repair
        The exported model.
    archive
        The exported FMU. It runs in this process, and every step takes some milliseconds.
    """
    chosen = _experiments(repair)
    if not chosen:
        return StepErrors(
            why_not=(
                "no experiment has outputs over time, a reported error and known values of all "
                "parameters"
            )
        )
    reported = _reported(repair, chosen)
    units = {e.output: e.unit for e in repair.errors}
    found = StepErrors(tuple(e.id for e in chosen), tuple(units.items()), tuple(reported.items()))
    step = _first_step(repair, chosen)
    model = _held_model(repair, archive)
    for _ in range(HALVINGS + 1):
        if sum(e.stop - e.start for e in chosen) / step > MOST_STEPS and found.measured:
            break
        try:
            errors = _errors_at(step, model, repair, chosen)
        except (ClusterEstError, ValueError) as error:
            if found.measured:
                break
            return StepErrors(why_not=str(error))
        found = replace(found, measured=(*found.measured, (step, tuple(errors.items()))))
        if _same(errors, reported, chosen):
            return replace(found, reproduces=step)
        step /= 2.0
    return found


def _experiments(repair: RepairedModel) -> tuple[Experiment, ...]:
    """Return the usable training experiments; if there are none, the held-out experiments."""
    measured = {e.experiment for e in repair.errors if np.isfinite(e.after)}
    usable = [
        e
        for e in repair.problem.experiments
        if e.outputs and e.id in measured and e.id in repair.of_experiments
    ]
    train = tuple(e for e in usable if e.role == "train")
    return train or tuple(usable)


def _reported(repair: RepairedModel, chosen: Sequence[Experiment]) -> Errors:
    """Return the run's error of each output over all samples of these experiments."""
    ids = {e.id for e in chosen}
    outputs = dict.fromkeys(o.variable for e in chosen for o in e.outputs)
    found = {}
    for name in outputs:
        rows = [e for e in repair.errors if e.experiment in ids and e.output == name]
        squares = [e.samples * e.after**2 for e in rows]
        found[name] = float(np.sqrt(sum(squares) / max(1, sum(e.samples for e in rows))))
    return found


def _first_step(repair: RepairedModel, chosen: Sequence[Experiment]) -> float:
    """Return the communication step of the run, otherwise the time between two samples."""
    solver = repair.problem.model.solver
    if solver.name == "fmu" and solver.step is not None:
        return solver.step
    times = [o.times for e in chosen for o in e.outputs if len(o.times) > 1]
    gaps = np.concatenate([np.diff(each) for each in times]) if times else np.zeros(0)
    longest = max(e.stop - e.start for e in chosen)
    return float(np.float64(f"{np.median(gaps):.6g}")) if len(gaps) else longest / 1000.0


def _held_model(repair: RepairedModel, archive: bytes) -> Model:
    """Return the exported FMU for co-simulation, without interpolation of its inputs."""
    named = dict.fromkeys(n for values in repair.of_experiments.values() for n in values)
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == XML:
                root = ET.fromstring(content)
                for interface in root.iter("CoSimulation"):
                    interface.set("canInterpolateInputs", "false")
                content = bytes(ET.tostring(root))
            new.writestr(entry, content)
    solver = Solver("fmu", max_steps=2 * MOST_STEPS)
    name = f"{repair.problem.model.name} as exported"
    return Model(name, target.getvalue(), "co_simulation", solver, tuple(named))


def _errors_at(
    step: float,
    model: Model,
    repair: RepairedModel,
    chosen: Sequence[Experiment],
) -> Errors:
    """Simulate all experiments at a communication step.

    Raises
    ------
    ModelError
        If the exported FMU cannot be loaded.
    ValueError
        If it cannot be simulated.
    """
    model = replace(model, solver=replace(model.solver, step=step))
    signals = [name for effect in repair.effects for name in effect.uses]
    fed = [_fed(experiment, signals) for experiment in chosen]
    squares: dict[str, list[float]] = {}
    evaluator = Evaluator(model, tuple(fed), "export")
    try:
        for number, experiment in enumerate(chosen):
            known = {**dict(experiment.values), **repair.of_experiments[experiment.id]}
            values = np.array([float(known[name]) for name in model.parameters])
            task = Task(0, number, values, "trajectory")
            (outcome,) = evaluator.evaluate(TaskBatch.of([task]))
            if not outcome.ok:
                raise ValueError(f"experiment {experiment.id!r} failed ({outcome.message})")
            for output in experiment.outputs:
                residuals = output_residuals(output, outcome)
                assert residuals is not None  # it has a trajectory
                own = squares.setdefault(output.variable, [0.0, 0.0])
                own[0] += float(np.add.reduce((residuals * output.sigmas) ** 2))
                own[1] += len(residuals)
    finally:
        evaluator.close()
    return {name: float(np.sqrt(total / count)) for name, (total, count) in squares.items()}


def _fed(experiment: Experiment, signals: Sequence[str]) -> Experiment:
    """Return the experiment with the signals of effects as inputs, and with outputs only."""
    more = [given for given in experiment.signals if given.variable in signals]
    return replace(
        experiment,
        inputs=(*experiment.inputs, *more),
        signals=(),
        curve=None,
        bounds=(),
        cost_function=None,
        constraint_functions=(),
    )


def _same(errors: Errors, reported: Errors, chosen: Sequence[Experiment]) -> bool:
    """Return whether all errors are those of the run."""
    for name, value in errors.items():
        own = [o.values for e in chosen for o in e.outputs if o.variable == name]
        room = SAME_STEP_ERROR * reported[name] + NEGLIGIBLE_DIFFERENCE * float(
            np.std(np.concatenate(own))
        )
        if abs(value - reported[name]) > room:
            return False
    return True
