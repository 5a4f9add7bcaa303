"""Classical test functions as problems: an executor computes residuals instead of simulating."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from support.problems.answering import AnsweringExecutor, answer_with

from cluster_est import Budget, Experiment, Model, Output, Parameter, Problem, Solver
from cluster_est.executors import Executor
from cluster_est.methods import Method
from cluster_est.methods.method import Points, Solution
from cluster_est.problem.costs import Cost, SumSquared
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest, assemble_evaluation
from workers.messages import Outcome, Task, UserFunction


@dataclass(frozen=True)
class FunctionProblem:
    """Residuals r(x), where to start, and the minimum of the sum of squares.

    `constraints(x)` must be at most 0, or 0 where `equality`; `cost` takes the place of the sum of
    squares.
    """

    name: str
    residuals: Callable[[np.ndarray], np.ndarray]
    start: tuple[float, ...]
    minimum: float
    lower: tuple[float, ...] | None = None
    upper: tuple[float, ...] | None = None
    constraints: Callable[[np.ndarray], np.ndarray] | None = None
    equality: tuple[bool, ...] = ()
    cost: Cost = field(default_factory=SumSquared)

    def problem(self) -> Problem:
        size = len(self.residuals(np.array(self.start)))
        times = np.arange(1.0, size + 1.0)
        outputs = (Output("y", times, 0.0 * times),)
        functions = tuple(
            UserFunction("none", f"c{i}", equality=equal) for i, equal in enumerate(self.equality)
        )
        experiment = Experiment("e", 0.0, size + 1.0, (), outputs, constraint_functions=functions)
        lower = self.lower or (-np.inf,) * len(self.start)
        upper = self.upper or (np.inf,) * len(self.start)
        bounded = zip(self.start, zip(lower, upper, strict=True), strict=True)
        parameters = tuple(Parameter(f"x{i}", *each) for i, each in enumerate(bounded))
        names = tuple(p.name for p in parameters)
        model = Model("none", b"", "model_exchange", Solver("rk4"), names)
        return Problem(model, parameters, (experiment,), self.cost)

    def space(self) -> SearchSpace:
        return make_space(self.problem(), (0,))

    def answer(self, task: Task) -> Outcome:
        """Answer a task as a worker would."""
        return FunctionExecutor(self.residuals, self.constraints)._answer(task)

    def solve(
        self,
        method: Method,
        seed: int = 0,
        workers: int = 1,
        *,
        executor: Executor | None = None,
        budget: Budget | None = None,
    ) -> Solution:
        opened = executor or FunctionExecutor(self.residuals, self.constraints, workers)
        request = SearchRequest("test", method, self.space(), seed)
        return Runner(opened, budget).run([request])[0]


class FunctionExecutor(AnsweringExecutor):
    """Answers a task with the residuals of a function; not finite counts as a failure.

    Of several workers, the one that began last is always the first to answer.
    """

    def __init__(
        self,
        residuals: Callable[[np.ndarray], np.ndarray],
        constraints: Callable[[np.ndarray], np.ndarray] | None = None,
        workers: int = 1,
    ) -> None:
        super().__init__()
        self.workers = workers
        self._residuals = residuals
        self._constraints = constraints or (lambda x: np.zeros(0))

    def completed(self):
        if self.workers > 1 and self._queue:
            return [self._answer(self._queue.pop(min(self.workers, len(self._queue)) - 1))]
        return super().completed()

    def _answer(self, task):
        with np.errstate(all="ignore"):
            values = np.asarray(self._residuals(task.values), np.float64)
        constraints = np.asarray(self._constraints(task.values), np.float64)
        return answer_with(task, values, [len(values)], constraints)


@dataclass(frozen=True)
class Followed:
    """A search that was driven by hand: what it found, and all that it asked for."""

    solution: Solution
    requests: list[Points]

    @property
    def points(self) -> np.ndarray:
        return np.vstack([request.x for request in self.requests])

    @property
    def purposes(self) -> list[str]:
        return [request.purpose for request in self.requests]


def followed(problem: FunctionProblem, method: Method, seed: int = 0) -> Followed:
    """Search without a runner, request by request."""
    space, executor = problem.space(), FunctionExecutor(problem.residuals, problem.constraints)
    search = method.search(space, np.random.default_rng(seed))
    request, requests = next(search), list[Points]()
    while True:
        requests.append(replace(request, x=request.x.copy()))
        executor.submit([Task(i, 0, x) for i, x in enumerate(request.x)])
        pairs = enumerate(zip(request.x, executor.completed(), strict=True))
        answers = [assemble_evaluation(space, x, (outcome,), i) for i, (x, outcome) in pairs]
        try:
            request = search.send(answers)
        except StopIteration as end:
            return Followed(end.value, requests)


def rosenbrock(x):
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def walled(x):
    """The same, but right of its minimum and below the valley nothing can be simulated."""
    return rosenbrock(x) if x[1] > -2.0 and x[0] < 1.05 else np.full(2, np.nan)


def powell_singular(x):
    a, b, c, d = x
    return np.array([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2])


def beale(x):
    return np.array([y - x[0] * (1.0 - x[1] ** i) for i, y in ((1, 1.5), (2, 2.25), (3, 2.625))])


def brown_dennis(x):
    t = np.arange(1, 21) / 5.0
    first = x[0] + t * x[1] - np.exp(t)
    second = x[2] + x[3] * np.sin(t) - np.cos(t)
    return first**2 + second**2


def freudenstein_roth(x):
    first = -13.0 + x[0] + ((5.0 - x[1]) * x[1] - 2.0) * x[1]
    return np.array([first, -29.0 + x[0] + ((x[1] + 1.0) * x[1] - 14.0) * x[1]])


def kowalik_osborne(x):
    y = np.array([0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246])  # fmt: skip # noqa: E501
    u = np.array([4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])
    return y - x[0] * (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3])


def bard(x):
    y = np.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39])  # fmt: skip # noqa: E501
    u = np.arange(1.0, 16.0)
    v = 16.0 - u
    return y - (x[0] + u / (v * x[1] + np.minimum(u, v) * x[2]))


ROSENBROCK = FunctionProblem("rosenbrock", rosenbrock, (-1.2, 1.0), 0.0)
WALLED = replace(ROSENBROCK, name="walled", residuals=walled)
PROBLEMS = [
    ROSENBROCK,
    FunctionProblem("rosenbrock far", rosenbrock, (-120.0, 100.0), 0.0),
    FunctionProblem("powell singular", powell_singular, (3.0, -1.0, 0.0, 1.0), 0.0),
    FunctionProblem("beale", beale, (1.0, 0.8), 0.0),
    FunctionProblem("brown dennis", brown_dennis, (25.0, 5.0, -5.0, -1.0), 85822.2016263),
    FunctionProblem("freudenstein roth", freudenstein_roth, (6.0, 5.5), 0.0),
    FunctionProblem("kowalik osborne", kowalik_osborne, (0.25, 0.39, 0.415, 0.39), 3.0750560385e-4),
    FunctionProblem("bard", bard, (1.0, 1.0, 1.0), 8.2148773066e-3),
    # the unbounded minimum (1, 1) is outside: on the bound x0 = 0.5 the best is x1 = 0.25
    FunctionProblem("rosenbrock bounded", rosenbrock, (-1.2, 1.0), 0.25, (-2.0, -2.0), (0.5, 2.0)),
    # from a corner, with a bound active on the way and free at the end
    FunctionProblem(
        "bard bounded", bard, (0.1, 0.1, 3.0), 8.2148773066e-3, (0.05, 0.1, 0.5), (1, 3, 3)
    ),
]
"""Minima from J. J. More, B. S. Garbow, K. E. Hillstrom, Testing unconstrained optimization
software, ACM TOMS 7 (1981) 17-41, doi:10.1145/355934.355936, to more digits where known."""


def named(name: str, problems: list[FunctionProblem] = PROBLEMS) -> FunctionProblem:
    return next(problem for problem in problems if problem.name == name)
