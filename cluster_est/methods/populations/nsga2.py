"""NSGA-II for several objectives, with the algorithm of pymoo.

K. Deb, A. Pratap, S. Agarwal, T. Meyarivan, IEEE Trans. Evol. Comput. 6 (2002) 182-197,
doi:10.1109/4235.996017.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.method import Evaluation, OtherPoint
from cluster_est.methods.populations.population_method import (
    PopulationGoal,
    PopulationMember,
)
from cluster_est.methods.populations.pymoo_methods import PymooMethod
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

Kind = Literal["outputs", "experiments"]


@dataclass(frozen=True)
class Nsga2(PymooMethod):
    """Multi-objective search for the Pareto front: the points that no other point dominates.

    Use it before you choose weights. It shows how a better fit of one output or experiment worsens
    the fit of the others, and whether the objectives are in conflict. For a single solution,
    minimise the sum of costs with another method. With more than about four objectives hardly any
    point dominates another, and the search makes no progress.

    The solution is the point of least total cost, as in the other methods. Its `others` are all
    points of the Pareto front, least cost first.

    Attributes
    ----------
    objectives
        The parts with a separate cost: each output variable over all experiments ("outputs"), or
        each experiment with all its outputs ("experiments").
    population, max_generations
        As in every `PopulationMethod`. The default population is 100 points, which is also the
        largest size of the front.
    xtol
        As in every `PopulationMethod`: converged when all points of the front are equal.
    ftol, window
        Converged when the front has moved, on average, by at most `ftol` of the gap between
        neighbours in `window` generations. This movement is never much below 0.2, because the
        gaps are filled at random.
    crossover_eta, mutation_eta
        As in `ga`.
    """

    name: ClassVar[str] = "nsga2"

    objectives: Kind = "outputs"
    ftol: float = field(default=0.4, metadata={"least": 0.0})
    crossover_eta: float = field(default=15.0, metadata={"least": 1.0})
    mutation_eta: float = field(default=20.0, metadata={"least": 1.0})

    @override
    def check(self, space: SearchSpace) -> None:
        super().check(space)
        if space.priors:
            raise ProblemError(
                f"method.name: {self.name} treats the costs of outputs or experiments separately, "
                "but a prior belongs to neither; remove the priors, or use another method"
            )
        if self.objectives == "outputs" and any(
            space.problem.experiments[e].cost_function for e in space.experiments
        ):
            raise ProblemError(
                'method.options.objectives: must be "experiments" if an experiment has a cost '
                'function (its cost belongs to no single output), but is "outputs"; change it, or '
                "remove the cost functions"
            )
        count = ParetoFront.count(self.objectives, space)
        if count < 2:
            raise ProblemError(
                f"method.options.objectives: there must be at least two {self.objectives} to treat "
                f"separately, but there {'is one' if count else 'are none'}; set objectives to "
                '"outputs" or "experiments", whichever are more, or use another method'
            )

    @override
    def usual_population(self, unknowns: int) -> int:
        return 100

    @override
    def algorithm(self, size: int) -> tuple[Any, dict[str, Any]]:
        from pymoo.algorithms.moo.nsga2 import NSGA2
        from pymoo.operators.crossover.sbx import SBX
        from pymoo.operators.mutation.pm import PM

        return NSGA2, {
            "pop_size": size,
            "crossover": SBX(prob=0.9, eta=self.crossover_eta),
            "mutation": PM(eta=self.mutation_eta),
        }

    @override
    def goal(self, space: SearchSpace) -> PopulationGoal:
        return ParetoFront(space, self.objectives, self.ftol, self.window)


class ParetoFront(PopulationGoal):
    """The Pareto front of the members; settled if it hardly moves."""

    def __init__(self, space: SearchSpace, kind: Kind, ftol: float, window: int) -> None:
        self._space, self._kind, self._ftol, self._window = space, kind, ftol, window
        self.objectives = self.count(kind, space)
        self._measured = _measured(space)
        self._fronts: list[FloatArray] = []

    @staticmethod
    def count(kind: Kind, space: SearchSpace) -> int:
        if kind == "outputs":
            return len(np.unique(space.outputs))
        return sum(_measured(space))

    @override
    def values(self, evaluation: Evaluation) -> FloatArray:
        residuals, outputs = evaluation.residuals, self._space.outputs
        cost = self._space.problem.cost
        found = []
        for rows in self._parts(evaluation):
            numbers = np.unique(outputs[rows], return_inverse=True)[1] if len(outputs) else outputs
            found.append(cost.value(np.ascontiguousarray(residuals[rows]), numbers))
        return np.array(found, np.float64)

    def _parts(self, evaluation: Evaluation) -> Sequence[slice | npt.NDArray[np.bool_]]:
        """Return the rows of the residuals of each objective."""
        if self._kind == "experiments":
            return list(compress(evaluation.rows, self._measured))
        return [self._space.outputs == output for output in range(self.objectives)]

    @override
    def settled(self, best: PopulationMember, members: Sequence[PopulationMember]) -> bool:
        self._fronts.append(np.array([member.values for member in _non_dominated(members)]))
        if len(self._fronts) <= self._window:
            return False
        before, now = self._fronts.pop(0), self._fronts[-1]
        return bool(len(before) and len(now) and _progress(before, now) <= self._ftol)

    @override
    def others(
        self, best: PopulationMember, members: Sequence[PopulationMember]
    ) -> tuple[OtherPoint, ...]:
        front = _non_dominated([best, *members])
        found = [OtherPoint(m.x, m.cost, tuple(m.values.tolist())) for m in front]
        return tuple(sorted(found, key=lambda other: (other.cost, other.objectives)))


def _measured(space: SearchSpace) -> list[bool]:
    """Return whether each experiment has residuals; it may have constraints only."""
    chosen = [space.problem.experiments[e] for e in space.experiments]
    return [bool(e.size or e.cost_function) for e in chosen]


def _non_dominated(members: Sequence[PopulationMember]) -> list[PopulationMember]:
    """Return the feasible, non-dominated members without duplicates."""
    allowed = [member for member in members if member.violation == 0.0]
    if not allowed:
        return []
    values, first = np.unique([m.values for m in allowed], axis=0, return_index=True)
    as_good = (values[:, None] <= values[None]).all(axis=2)
    dominated = as_good.sum(axis=0) > 1
    return [allowed[i] for i in np.sort(first[~dominated]).tolist()]


def _progress(before: FloatArray, now: FloatArray) -> float:
    """Return the mean distance from a front to a later front, in units of the later front's gaps.

    The distance of a point of `now` is the least shift after which a point of `before` is as good
    in all objectives. The unit of each objective is its range. This is the additive epsilon
    indicator of E. Zitzler, L. Thiele, M. Laumanns, C. Fonseca, V. da Fonseca, IEEE Trans. Evol.
    Comput. 7 (2003) 117-132, doi:10.1109/TEVC.2003.810758, for one point at a time.
    """
    ranges = np.ptp(np.vstack([before, now]), axis=0)
    shifts = (before[:, None] - now[None]) / np.where(ranges > 0.0, ranges, 1.0)
    epsilon = np.ascontiguousarray(shifts.max(axis=2).min(axis=0))
    gap = len(now) ** (-1.0 / (now.shape[1] - 1))
    return float(np.add.reduce(epsilon) / len(now) / gap)
