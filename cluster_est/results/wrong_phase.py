"""Fits of models that swing which ended in a minimum of a wrong phase.

The sum of squares of an oscillation over the logarithm of its frequency has a minimum at each
number of cycles in the record, and its main one is about one cycle wide: a search that begins
farther away ends beside it, with another period, or damps the simulation until it hardly moves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.problem.problem import Problem
from cluster_est.results.output_errors import Simulation, compared_values
from workers.messages import Experiment, FloatArray, Output

POOR = 0.7
"""Error over the spread of what was measured from which on a fit misses it."""
LEAST_CYCLES, OTHER_CYCLES = 2.5, 0.5
"""Cycles in a record from which on it swings, and by which a simulation has others."""
LEAST_SHARE, BAND = 0.5, 1.25
"""Share of the variance that lies in one band of frequencies, and its ends over its middle."""
HARDLY_MOVING = 0.3
"""Spread of a simulation over that of the measurement below which it hardly moves."""
MOST_TRANSFORMED_SAMPLES = 8192


@dataclass(frozen=True)
class Swing:
    """The oscillation that carries most of a signal: its cycles in the record, and its period."""

    cycles: float
    period: float


def swing_of(times: FloatArray, values: FloatArray) -> Swing | None:
    """Return the oscillation of a signal; None if no band of frequencies has half its variance."""
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
    """Say where a fitted model swings otherwise than was measured, and what else to try.

    Parameters
    ----------
    problem
        That was fitted.
    simulations
        Of its experiments at the estimates, with trajectories.
    starts
        From which the search began.

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
        "begins far from the solution may end in a minimum with a wrong phase. Try multistart.n = "
        f"{more}; or segments in which a phase error cannot grow, method.shooting = {{ length = "
        f"{2.0 * measured.period:.3g} }}; or a start with about the right period",
    )


def _wrong(
    experiment: Experiment, output: Output, simulation: Simulation
) -> Iterator[tuple[float, Swing, str]]:
    """Yield the error over the spread, the measured swing and what the model does, if wrong."""
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
    """Return whether an input swings as the output does, which then has its period from there."""
    swings = (swing_of(given.times, given.values) for given in experiment.inputs)
    return any(
        each is not None and 1.0 / BAND < each.period / measured.period < BAND for each in swings
    )
