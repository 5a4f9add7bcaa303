"""Detects large residuals of a poor fit just after jumps of an input."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.problem.problem import Problem
from cluster_est.problem.tables.jumps import interpolated, jump_times, samples_after
from cluster_est.results.output_errors import Simulation, output_residuals
from cluster_est.statistics.residual_findings import ResidualDiagnostics
from workers.messages import Experiment, FloatArray

SAMPLES = 10
"""Number of samples after a jump that count as being just after it."""
TIMES_AS_LARGE = 2.0
"""Least ratio of the root mean square after jumps to that elsewhere, for a note."""
MOST_OF_RECORD = 0.5
"""Largest share of the samples that are after jumps; above it, these are not exceptional."""
LEAST_SAMPLES = 10


@dataclass(frozen=True)
class _Place:
    """The largest residual of an output after jumps of an input."""

    size: float
    experiment: str
    time: float
    jump: float


def after_jump_sentences(
    problem: Problem,
    simulations: Sequence[Simulation],
    diagnostics: ResidualDiagnostics,
    told: str = "",
    linear: Collection[str] = (),
) -> tuple[str, ...]:
    """Return sentences on large residuals after jumps of inputs with linear interpolation.

    Parameters
    ----------
    problem, simulations
        The fitted problem, and its simulations at the estimates.
    diagnostics
        Findings on the residuals. Without findings, no sentence is returned.
    told
        An input that other sentences describe; it is left out here.
    linear
        Inputs whose linear interpolation the measurements confirm. The interpolation is then not
        the cause of the residuals.
    """
    if not diagnostics.findings:
        return ()
    holds = problem.describe().holds
    runs = [(each, problem.experiments[each.experiment]) for each in simulations]
    runs = [(each, run) for each, run in runs if run.role == "train"]
    names = dict.fromkeys(
        given.variable
        for _, run in runs
        for given in run.inputs
        if given.interpolation == "linear" and not holds(given.variable)
    )
    outputs = dict.fromkeys(output.variable for _, run in runs for output in run.outputs)
    found = []
    for name in names:
        places = [_largest(runs, name, output) for output in outputs] if name != told else []
        worst = max(
            ((each, o) for each, o in zip(places, outputs, strict=False) if each is not None),
            key=lambda pair: pair[0].size,
            default=None,
        )
        if worst is not None:
            said, remedy = _sentences(problem, name, *worst)
            found.append(said if name in linear else f"{said}. {remedy}")
    return tuple(found)


def _sentences(problem: Problem, name: str, place: _Place, output: str) -> tuple[str, str]:
    """Return where the residual is large, and what to do if the interpolation is the cause."""
    return (
        f"the error of {output} is largest just after jumps of input {name}: it is "
        f"{place.size:.2g} times the error elsewhere at {place.time:.6g} s in experiment "
        f"{place.experiment!r}, after the jump at {place.jump:.6g} s",
        "Linear interpolation turns this jump into a ramp; if the input keeps each value until "
        "the next sample, set "
        f"{interpolated(name, problem.columns, 'hold')}",
    )


def _largest(
    runs: Sequence[tuple[Simulation, Experiment]], name: str, variable: str
) -> _Place | None:
    """Return the largest residual after jumps of an input; None if none is clearly larger there."""
    inside: list[FloatArray] = []
    outside: list[FloatArray] = []
    places: list[_Place] = []
    for simulation, run in runs:
        jumps = [jump_times(i) for i in run.inputs if i.variable == name]
        for output in (o for o in run.outputs if o.variable == variable):
            residuals = output_residuals(output, simulation.outcome)
            if residuals is None or not len(residuals) or not np.isfinite(residuals).all():
                continue
            times = jumps[0] if jumps else np.zeros(0)
            after = samples_after(output.times, times, count=SAMPLES)
            after &= output.times >= (times[0] if len(times) else np.inf)
            inside.append(residuals[after])
            outside.append(residuals[~after])
            if after.any():
                at = int(np.argmax(np.where(after, np.abs(residuals), -1.0)))
                when = float(output.times[at])
                jump = float(times[np.searchsorted(times, when, side="right") - 1])
                places.append(_Place(float(abs(residuals[at])), run.id, when, jump))
    near, far = (np.concatenate([np.zeros(0), *parts]) for parts in (inside, outside))
    if len(near) < LEAST_SAMPLES or len(near) > MOST_OF_RECORD * (len(near) + len(far)):
        return None
    size, usual = (float(np.sqrt(np.mean(part**2))) for part in (near, far))
    if not size > TIMES_AS_LARGE * usual > 0.0:
        return None
    worst = max(places, key=lambda each: each.size)
    return _Place(worst.size / usual, worst.experiment, worst.time, worst.jump)
