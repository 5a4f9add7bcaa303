"""Detects fits of oscillating models that ended in a minimum with a wrong phase.

As a function of the frequency of an oscillation, the sum of squares has a minimum for each number
of cycles in the record. The global minimum is about one cycle wide. A search that begins farther
away ends in another minimum, with a wrong period, or damps the simulation until it hardly moves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.problem.problem import Problem
from cluster_est.results.output_errors import Simulation, compared_values
from workers.messages import Experiment, FloatArray, Output

POOR = 0.7
"""Error over the standard deviation of the measured signal above which a fit is poor."""
LEAST_CYCLES, OTHER_CYCLES = 2.5, 0.5
"""Least number of cycles of an oscillating record; least difference in the number of cycles."""
LEAST_SHARE, BAND = 0.5, 1.25
"""Least share of the variance in one frequency band; ratio of the band's ends to its centre."""
HARDLY_MOVING = 0.3
"""Ratio of simulated to measured standard deviation below which a simulation hardly moves."""
MOST_TRANSFORMED_SAMPLES = 8192


@dataclass(frozen=True)
class Swing:
    """The dominant oscillation of a signal: its number of cycles in the record, and its period."""

    cycles: float
    period: float


def swing_of(times: FloatArray, values: FloatArray) -> Swing | None:
    """Return the oscillation of a signal; None if no frequency band has half of its variance."""
    count = min(len(times), MOST_TRANSFORMED_SAMPLES)
    long = float(times[-1] - times[0]) if count > 3 else 0.0
    if long <= 0.0 or not np.isfinite(values).all():
        return None
    even = np.interp(np.linspace(times[0], times[-1], count), times, values)
    line = np.linspace(-1.0, 1.0, count)
    even = even - np.mean(even) - line * float(line @ even) / float(line @ line)
    power = np.abs(np.fft.rfft(even)) ** 2
    power[0] = 0.0
    peak = int(np.argmax(power))
    if not power[peak] > 0.0:
        return None
    around = power[max(peak - 1, 0) : peak + 2]
    cycles = float(np.arange(max(peak - 1, 0), peak + 2)[: len(around)] @ around / around.sum())
    numbers = np.arange(len(power))
    band = (numbers >= cycles / BAND - 1.0) & (numbers <= cycles * BAND + 1.0)
    if cycles < LEAST_CYCLES or power[band].sum() < LEAST_SHARE * power.sum():
        return None
    return Swing(cycles, long / cycles)


def wrong_phase_notes(
    problem: Problem, simulations: Sequence[Simulation], starts: int
) -> tuple[str, ...]:
    """Return a note if a fitted model oscillates differently from the measurement, with advice.

    Parameters
    ----------
    problem
        The fitted problem.
    simulations
        Simulations of its experiments at the estimates, with trajectories.
    starts
        Number of starts of the search.

    Returns
    -------
    tuple of str
        One sentence on the worst output of the training experiments; empty if there is none.
    """
    found = [
        (error, output.variable, experiment.id, measured, how)
        for each in simulations
        if (experiment := problem.experiments[each.experiment]).role == "train"
        for output in experiment.outputs
        for error, measured, how in _wrong(experiment, output, each)
    ]
    if not found:
        return ()
    _, name, where, measured, how = max(found, key=lambda each: each[0])
    more = f"{max(20, 5 * starts)}"
    return (
        f"in {where}, {name} oscillates with a period of {measured.period:.3g} s, "
        f"{measured.cycles:.0f} times in the record, but the fitted model {how}: a search that "
        "begins far from the solution may end in a minimum with a wrong phase. Try several "
        f"starts (multistart.n = {more}), multiple shooting with segments in which a phase error "
        f"cannot grow (method.shooting = {{ length = {2.0 * measured.period:.3g} }}), or start "
        "values with about the right period",
    )


def _wrong(
    experiment: Experiment, output: Output, simulation: Simulation
) -> Iterator[tuple[float, Swing, str]]:
    """Yield relative error, measured oscillation, and the model's behaviour, if it is wrong."""
    simulated = None if output.ordinal else compared_values(output, simulation.outcome)
    if simulated is None or len(output.values) < 2:
        return
    spread = float(np.std(output.values))
    error = float(np.sqrt(np.mean((output.values - simulated) ** 2)))
    if not error > POOR * spread:
        return
    measured = swing_of(output.times, output.values)
    if measured is None or _is_driven(experiment, measured):
        return
    own = swing_of(output.times, simulated)
    if own is not None and abs(own.cycles - measured.cycles) > OTHER_CYCLES:
        yield error / spread, measured, f"oscillates every {own.period:.3g} s"
    elif float(np.std(simulated)) < HARDLY_MOVING * spread:
        yield error / spread, measured, "hardly moves"


def _is_driven(experiment: Experiment, measured: Swing) -> bool:
    """Return whether an input oscillates with the output's period, which it then determines."""
    swings = (swing_of(given.times, given.values) for given in experiment.inputs)
    return any(
        each is not None and 1.0 / BAND < each.period / measured.period < BAND for each in swings
    )
