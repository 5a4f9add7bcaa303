"""Problems whose outputs are formulas, over any experiments, and an executor for them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from support.problems.answering import AnsweringExecutor, answer_with

from cluster_est import Experiment, LeastSquares, Model, Output, Parameter, Problem, Solver
from cluster_est.methods import Method
from cluster_est.methods.method import Solution
from cluster_est.problem.costs import Cost, SumSquared
from cluster_est.problem.formulas import parse_constraint
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

Formula = Callable[[np.ndarray, np.ndarray, int], np.ndarray]


@dataclass(frozen=True)
class Curves:
    """Measured curves and the formula that should follow them.

    `formula(times, values, experiment)` gives the outputs of an experiment, (times,) or
    (outputs, times), at the values of `parameters` that are neither derived nor auxiliary.
    `measured` holds them for each experiment.
    """

    formula: Formula
    parameters: tuple[Parameter, ...]
    times: np.ndarray
    measured: Sequence[np.ndarray]
    groups: Sequence[str] | None = None
    cost: Cost = field(default_factory=SumSquared)
    constraints: tuple[str, ...] = ()
    sigma: float = 1.0

    def problem(self) -> Problem:
        runs = []
        for e, measured in enumerate(self.measured):
            rows = enumerate(np.atleast_2d(measured))
            outputs = tuple(Output(f"y{j}", self.times, r, sigma=self.sigma) for j, r in rows)
            groups = () if self.groups is None else (("g", self.groups[e]),)
            stop = float(self.times[-1])
            runs.append(Experiment(f"e{e}", 0.0, stop, (), outputs, groups=groups))
        names = tuple(p.name for p in self.parameters)
        constraints = tuple(
            each
            for text in self.constraints
            for each in parse_constraint(text, names, "constraints", "", 1.0)
        )
        targets = tuple(p.target for p in self.parameters if not p.auxiliary)
        model = Model("none", b"", "model_exchange", Solver("rk4"), targets)
        cost = self.cost
        return Problem(model, self.parameters, tuple(runs), cost, constraints=constraints)

    def runner(self) -> Runner:
        return Runner(CurveExecutor(self))

    def space(self) -> SearchSpace:
        return make_space(self.problem(), tuple(range(len(self.measured))))

    def solve(self, method: Method | None = None) -> tuple[Runner, SearchSpace, Solution]:
        """Fit; what stands ready for what comes after it."""
        runner, space = self.runner(), self.space()
        (solution,) = runner.run([SearchRequest("fit", method or LeastSquares(), space)])
        return runner, space, solution


class CurveExecutor(AnsweringExecutor):
    """Answers a task with measured - formula; not finite counts as a failure."""

    def __init__(self, curves: Curves) -> None:
        super().__init__()
        self._curves = curves
        self.answered = 0

    def _answer(self, task):
        self.answered += 1
        curves = self._curves
        with np.errstate(all="ignore"):
            found = curves.formula(curves.times, task.values, task.experiment)
        residuals = (curves.measured[task.experiment] - found).ravel()
        size = len(curves.times)
        return answer_with(task, residuals, [size] * (len(residuals) // size))
