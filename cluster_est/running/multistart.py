"""Searches from many starts with one method, for costs with several minima.

All searches share one queue of tasks, so workers are busy while a search waits for its slowest
simulation. The result does not depend on the speed of the searches: starts count in their order.

Before a search, scales and offsets of sensors without an explicit start get their best values at
the start of the other unknowns. Otherwise a scale that is wrong by orders of magnitude, or in its
sign, would drive the other parameters to wrong values first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, Strict

from cluster_est.errors import ProblemError
from cluster_est.methods.method import GivenPoints, Method, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.sensors import NEUTRAL, OFFSET, SCALE, UnstartedSensor, unstarted_sensors
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest, suited
from cluster_est.settings import Count, Finite, Positive, Settings
from cluster_est.toml import dotted
from workers.fmu.description import nearest
from workers.messages import FloatArray, Outcome
from workers.messages.types import by_content
from workers.residuals.observed import best_scale_and_offset

STARTS_AT_ONCE = 16
"""Number of starts whose trajectories are simulated together, limited by memory."""


def with_best_sensors(runner: Runner, space: SearchSpace, starts: FloatArray) -> FloatArray:
    """Return starts with the best scales and offsets of sensors without an explicit start.

    Parameters
    ----------
    starts : (starts, unknowns)
        Starts in search coordinates. Each is simulated once if there is such a sensor. A start does
        not change if its simulation fails. A scale or offset that the start sets does not change.
    """
    sensors = unstarted_sensors(space)
    if not sensors or not len(starts):
        return starts
    changed = starts.copy()
    for first in range(0, len(starts), STARTS_AT_ONCE):
        rows = range(first, min(first + STARTS_AT_ONCE, len(starts)))
        values = [space.physical(_neutral(space, sensors, starts[row])) for row in rows]
        outcomes = runner.simulate(
            np.concatenate(values),
            space.experiments * len(rows),
            "trajectory",
            "sensors",
            space.problem.effects,
        )
        count = len(space.experiments)
        for k, row in enumerate(rows):
            own = outcomes[k * count : (k + 1) * count]
            for sensor in sensors:
                _start_sensor(space, sensor, own, changed[row])
    return changed


def _neutral(
    space: SearchSpace, sensors: Sequence[UnstartedSensor], start: FloatArray
) -> FloatArray:
    found = start.copy()
    for sensor in sensors:
        for i, name in ((sensor.scale, SCALE), (sensor.offset, OFFSET)):
            if i is not None:
                found[i] = space.unknowns[i].to_search(NEUTRAL[name])
    return found


def _start_sensor(
    space: SearchSpace, sensor: UnstartedSensor, outcomes: Sequence[Outcome], x: FloatArray
) -> None:
    """Set the best scale and offset of a sensor in a start `x`, from all its measurements."""
    measured, simulated, sigmas = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    moving, given = sensor.offset is not None, _given_scale(space, sensor, x)
    for position in sensor.experiments:
        trajectory = outcomes[position].trajectory
        if trajectory is None:
            return
        for output in space.problem.experiments[space.experiments[position]].outputs:
            if output.variable == sensor.output and not output.ordinal:
                seen = ~output.is_hidden
                measured.append(output.values[seen])
                simulated.append(given * trajectory.at(output.variable, output.times)[seen])
                sigmas.append(output.sigmas[seen])
                moving |= output.free_offset
    parts = (np.concatenate(each) for each in (measured, simulated, sigmas))
    free = sensor.scale is not None and given == NEUTRAL[SCALE]
    scale, offset = best_scale_and_offset(*parts, free_scale=free, free_offset=moving)
    if not (np.isfinite(scale) and np.isfinite(offset) and scale != 0.0):
        return
    for i, value in ((sensor.scale, scale), (sensor.offset, offset)):
        if i is not None and x[i] == space.start[i]:
            found = float(
                np.clip(space.unknowns[i].to_search(value), space.lower[i], space.upper[i])
            )
            x[i] = found if np.isfinite(found) else x[i]


def _given_scale(space: SearchSpace, sensor: UnstartedSensor, x: FloatArray) -> float:
    """Return the scale that a start sets; 1 if it sets none."""
    i = sensor.scale
    if i is None or x[i] == space.start[i]:
        return NEUTRAL[SCALE]
    return space.unknowns[i].to_physical(float(x[i]))


Sampler = Literal["sobol", "latin_hypercube", "uniform"]
ATTEMPTS = 50
"""Number of samples drawn for each needed sample, with constraints on parameters."""
LEAST_ITERATIONS_OF_SEARCH = 10
"""Least number of iterations, each with a gradient, for which the budget of a search must last."""
SCREENED = 0.25
"""Part of the budget for the evaluation of starts if the budget is too small for one search."""


class Multistart(Settings):
    """Number and selection of the starts of searches."""

    section: ClassVar[str] = "multistart"

    n: Positive = Field(
        1,
        description="number of starts: first the start values of the parameters, then the points "
        'of "points", then samples within the bounds',
    )
    sampler: Sampler = Field(
        "sobol",
        description="how starts are sampled within the bounds; sobol and latin_hypercube cover "
        "them evenly; uniform: at random",
    )
    points: Annotated[tuple[dict[str, Finite], ...], Strict(False)] = Field(
        (),
        description="additional starts: [{ parameter = value }, ...]; parameters that are not "
        "named keep their start values",
    )
    screen: Positive = Field(
        1, description="number of samples evaluated for each start; the best samples become starts"
    )
    at_once: Positive = Field(
        16,
        description="number of starts that run at the same time, whatever the number of workers; "
        "fewer if a budget is too small for all of them",
    )
    patience: Count = Field(
        0, description="stop if this number of starts in a row has found no new minimum; 0: never"
    )
    same: Finite = Field(
        1e-3,
        gt=0.0,
        description="two minima count as the same if every unknown differs by less than this "
        "fraction of its range",
    )
    seed: Count = Field(0, description="seed of the sampler")

    @property
    def searches(self) -> int:
        """Number of searches."""
        return max(self.n, 1 + len(self.points))


@by_content
@dataclass(frozen=True)
class MultistartResult:
    """The minima that the searches found.

    Attributes
    ----------
    starts : (searches, unknowns)
        Starts in search coordinates, best first if the budget was too small for all searches.
    solutions
        Solution of each search.
    minima
        Indices of solutions, best first, one for each different minimum.
    minimum
        Index in `minima` of the minimum of each search; -1 if the search did not reach a minimum.
    """

    starts: FloatArray
    solutions: tuple[Solution, ...]
    minima: tuple[int, ...]
    minimum: tuple[int, ...]

    @property
    def best(self) -> Solution:
        """The best minimum; the best of all solutions if there is no minimum."""
        if self.minima:
            return self.solutions[self.minima[0]]
        return min(self.solutions, key=_rank)


def search_from_starts(
    runner: Runner, space: SearchSpace, method: Method, multistart: Multistart, seed: int
) -> MultistartResult:
    """Run a method from all starts at the same time.

    Raises
    ------
    ProblemError
        If samples are needed but an unknown has no finite bounds.
    """
    suitable = suited(space, method)
    starts = make_starts(runner, suitable, multistart)
    starts, at_once = plan_for_budget(runner, suitable, starts, multistart.at_once)
    names = ["train"] if len(starts) == 1 else [f"start {i}" for i in range(len(starts))]
    requests = [
        SearchRequest(name, method, space.starting_at(x), seed)
        for name, x in zip(names, starts, strict=True)
    ]

    def enough(solutions: Sequence[Solution]) -> bool:
        """Return whether the last `patience` solutions contain no new minimum."""
        if multistart.patience == 0 or len(solutions) <= multistart.patience:
            return False
        _, number = cluster(space, solutions, multistart.same)
        before = set(number[: -multistart.patience]) - {-1}
        latest = set(number[-multistart.patience :]) - {-1}
        return bool(before) and latest <= before

    solutions = runner.run(requests, at_once, enough)
    minima, minimum = cluster(space, solutions, multistart.same)
    return MultistartResult(starts[: len(solutions)], tuple(solutions), minima, minimum)


def plan_for_budget(
    runner: Runner, space: SearchSpace, starts: FloatArray, at_once: int
) -> tuple[FloatArray, int]:
    """Choose the order of the starts and the number of simultaneous searches.

    If the budget allows `LEAST_ITERATIONS_OF_SEARCH` gradients of each search, nothing changes.
    Otherwise searches with equal shares of the budget would all end too early. So as many starts
    are evaluated as leave enough budget for one search. Searches then begin with the best start,
    and only as many run at the same time as the budget allows.

    Returns
    -------
    tuple
        The starts in the order of their searches, and the number of simultaneous searches.
    """
    needed = LEAST_ITERATIONS_OF_SEARCH * (space.size + 2)
    left = runner.evaluations_left
    if len(starts) == 1 or left >= len(starts) * needed:
        return starts, at_once
    tried = min(len(starts), int(max(left - needed, SCREENED * left, 1)))
    ordered = np.vstack([_best_first(runner, space, starts[:tried], "starts"), starts[tried:]])
    return ordered, max(1, min(at_once, int(runner.evaluations_left // needed)))


def check_starts(space: SearchSpace, multistart: Multistart) -> None:
    """Raise an error if the starts do not fit the space, before any simulation.

    Raises
    ------
    ProblemError
        If a point of the user has a wrong label or lies out of bounds. Or if samples are needed but
        an unknown has no finite bounds.
    """
    for values in multistart.points:
        _named(space, values)
    if multistart.searches > 1 + len(multistart.points):
        _check_bounds(space)


def make_starts(runner: Runner, space: SearchSpace, multistart: Multistart) -> FloatArray:
    """Return the start of the space, the user's points, then samples: (searches, unknowns)."""
    named = [space.start, *(_named(space, values) for values in multistart.points)]
    given = with_best_sensors(runner, space, np.array(named))
    missing = multistart.searches - len(given)
    if missing <= 0:
        return given
    samples = sample(space, missing * multistart.screen, multistart)
    samples = with_best_sensors(runner, space, samples)
    if multistart.screen > 1:
        samples = _best_first(runner, space, samples, "screen")
    return np.vstack([*given, samples[:missing]])


def _best_first(runner: Runner, space: SearchSpace, points: FloatArray, name: str) -> FloatArray:
    """Evaluate points as a search of this name; return the points, best first."""
    (found,) = runner.run([SearchRequest(name, GivenPoints(points, "screen"), space)])
    if not found.evaluations:  # after an interrupt no search begins, so the order is irrelevant
        return points
    return points[sorted(range(len(points)), key=lambda i: (found.evaluations[i].rank, i))]


def sample(space: SearchSpace, count: int, multistart: Multistart) -> FloatArray:
    """Return samples (count, unknowns) within bounds that satisfy constraints on parameters.

    If too few of the drawn points satisfy them, the points with the least violation are included.

    Raises
    ------
    ProblemError
        If an unknown has no finite bounds.
    """
    _check_bounds(space)
    wanted = space.parameter_constraints(space.start)
    drawn = count * (ATTEMPTS if len(wanted) else 1)
    generator = np.random.default_rng(multistart.seed)
    unit = _unit(multistart.sampler, drawn, space.size, generator)
    lower, upper = _sampled_between(space)
    points = np.clip(lower + unit * (upper - lower), lower, upper)
    if not len(wanted):
        return points
    equality = space.equality[: len(wanted)]
    worst = np.array([_violation(space.parameter_constraints(x), equality) for x in points])
    order = np.argsort(np.maximum(worst, 0.0), kind="stable")
    return np.asarray(points[order[:count]])


def _sampled_between(space: SearchSpace) -> tuple[FloatArray, FloatArray]:
    """Return the bounds of samples; a sensor's scale and offset are not sampled."""
    lower, upper = space.lower.copy(), space.upper.copy()
    for sensor in unstarted_sensors(space):
        chosen = list(sensor.unknowns)
        lower[chosen] = upper[chosen] = space.start[chosen]
    return lower, upper


def _check_bounds(space: SearchSpace) -> None:
    lower, upper = _sampled_between(space)
    for i, unknown in enumerate(space.unknowns):
        if not (np.isfinite(lower[i]) and np.isfinite(upper[i])):
            positive = " and positive" if unknown.log else ""
            parameter = unknown.parameter
            raise ProblemError(
                f"{dotted('parameters', parameter.name)}.bounds: must be finite{positive} (starts "
                f"are sampled between them), but are [{parameter.lower:g}, "
                f"{parameter.upper:g}]; narrow them, or give multistart.points instead"
            )


def _unit(sampler: Sampler, count: int, size: int, generator: np.random.Generator) -> FloatArray:
    if sampler == "uniform":
        return generator.random((count, size))
    from scipy.stats import qmc  # slow to import, and few fits have several starts

    kinds = {"sobol": qmc.Sobol, "latin_hypercube": qmc.LatinHypercube}
    engine = kinds[sampler](size, rng=generator)
    if sampler == "sobol":  # balanced only for powers of two; warns about other numbers
        return np.asarray(engine.random_base2(max(0, (count - 1).bit_length()))[:count])
    return np.asarray(engine.random(count))


def _violation(values: FloatArray, equality: npt.NDArray[np.bool_]) -> float:
    sizes = np.where(equality, np.abs(values), values)
    return float(np.max(np.where(np.isnan(sizes), np.inf, sizes)))


def _named(space: SearchSpace, values: Mapping[str, float]) -> FloatArray:
    """Return a start of the user in search coordinates."""
    labels = [unknown.label for unknown in space.unknowns]
    names = [unknown.parameter.name for unknown in space.unknowns]
    for name in values:
        if name not in labels and name not in names:
            raise ProblemError(
                f"multistart.points: there is no unknown {name!r}{nearest(name, labels)}"
            )
    x = space.start.copy()
    for i, unknown in enumerate(space.unknowns):
        given = values.get(unknown.label, values.get(unknown.parameter.name))
        if given is not None:
            x[i] = unknown.to_search(given)
            if not (np.isfinite(x[i]) and space.lower[i] <= x[i] <= space.upper[i]):
                parameter = unknown.parameter
                raise ProblemError(
                    f"multistart.points: {unknown.label} must lie within its bounds "
                    f"[{parameter.lower:g}, "
                    f"{parameter.upper:g}]{' and be positive' if unknown.log else ''}, but is "
                    f"{given:g}; change the point"
                )
    return x


def cluster(
    space: SearchSpace, solutions: Sequence[Solution], same: float
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return indices of the best solution of each minimum, and the minimum of each solution.

    Solutions that did not reach a minimum have the number -1.
    """
    reached = [i for i, s in enumerate(solutions) if s.ending.success]
    order = sorted(reached, key=lambda i: (_rank(solutions[i]), i))
    minima: list[int] = []
    number = [-1] * len(solutions)
    for i in order:
        for place, other in enumerate(minima):
            if _same(space, solutions[i], solutions[other], same):
                number[i] = place
                break
        else:
            number[i] = len(minima)
            minima.append(i)
    return tuple(minima), tuple(number)


def _same(space: SearchSpace, one: Solution, other: Solution, same: float) -> bool:
    width = space.upper - space.lower
    width = np.where(np.isfinite(width), width, space.typical)
    return bool(np.all(np.abs(one.x - other.x) <= same * width))


def _rank(solution: Solution) -> tuple[float, float]:
    if solution.at is not None:
        return solution.at.rank
    return (0.0, solution.cost) if np.isfinite(solution.cost) else (np.inf, np.inf)
