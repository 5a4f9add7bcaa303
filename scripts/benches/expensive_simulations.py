"""How many simulations of an expensive model a fit of 20 parameters takes, beside SciPy and pymoo.

The model is a chain of ten tanks, each with an outflow and a loss, 20 parameters in all, as an FMU
that is built here; three levels are measured with 1 % of noise. What counts is the number of
simulations until the cost is within 5 % of the best one that anybody finds; seconds do not: a
simulation of a second, most of it asleep, would be asked for as often. Medians are over `starts` in
which every parameter is 10 to 60 % off; pymoo has `most` simulations.

With `budget`, only what `least_squares` makes of so many points: the cost at the end, beside that
of the same method which does not know that the budget has no room for a Jacobian and a step; and
that of ten starts among which the budget is planned, beside the best of ten that share it evenly.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
from pymoo.algorithms.soo.nonconvex.cmaes import CMAES
from pymoo.core.problem import ElementwiseProblem
from pymoo.optimize import minimize
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import cluster_est as ce
from benches import Row
from benches.common import Array, WrittenModel
from cluster_est.methods.method import Method, Search
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.multistart import Multistart, sample

OPTIONS = {"starts": 10, "most": 3000, "budget": 0}
TANKS, NOISE, CLOSE = 10, 0.01, 1.05
STARTS = 10
SEEN = (2, 5, 9)
WAYS: dict[str, dict[str, object]] = {
    "ours, defaults": {},
    "ours, trials = 1, forward": {"trials": 1, "differences": "forward"},
    "ours, secant_updates = 20 too": {"trials": 1, "differences": "forward", "secant_updates": 20},
}


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each method, or for each way to use a budget."""
    with tempfile.TemporaryDirectory() as folder:
        fmu = write_model(Path(folder))
        if options.budget:
            yield from with_budget(fmu, options.starts, options.budget)
            yield with_starts(fmu, options.starts, options.budget)
            return
        ways: dict[str, Callable[[ce.Problem], list[float]]] = {
            name: partial(of_ours, options=own) for name, own in WAYS.items()
        }
        ways["SciPy least_squares"] = of_scipy
        ways["pymoo CMA-ES"] = lambda problem: of_pymoo(problem, options.most)
        counts: dict[str, list[float]] = {name: [] for name in ways}
        totals: dict[str, list[int]] = {name: [] for name in ways}
        for seed in range(options.starts):
            problem = made_problem(fmu, seed)
            found = {name: way(problem) for name, way in ways.items()}
            best = min(min(costs) for costs in found.values())
            for name, costs in found.items():
                counts[name].append(until(costs, best))
                totals[name].append(len(costs))
    for name, reached in counts.items():
        never = sum(not np.isfinite(each) for each in reached)
        yield {"method": name, "simulations, median": float(np.median(reached)),
               "never there": never, "in all, median": float(np.median(totals[name]))}  # fmt: skip


def write_model(folder: Path) -> Path:
    """The FMU of the chain of tanks."""
    numbers = range(TANKS)
    starts = {f"{letter}{i}": s for i in numbers for letter, s in (("a", 1.0), ("b", 0.1))}
    equations = []
    for i in numbers:
        inflow = "M(u)" if i == 0 else f"M(a{i - 1}) * M(h{i - 1})"
        loss = f"M(b{i}) * M(h{i}) * fabs(M(h{i}))"
        equations.append(f"der_h{i} = {inflow} - M(a{i}) * M(h{i}) - {loss}")
    states, shown = [f"h{i}" for i in numbers], [f"h{i}" for i in SEEN]
    model = WrittenModel("tanks", starts, ("u",), states, shown, equations, 20.0, 0.2, 0.05)
    return model.build(folder)


def made_problem(fmu: Path, seed: int) -> ce.Problem:
    """Data of one experiment, and a start that is some way off."""
    generator = np.random.default_rng(seed)
    true = np.empty(2 * TANKS)
    true[::2], true[1::2] = generator.uniform(0.5, 1.5, TANKS), generator.uniform(0.05, 0.2, TANKS)
    times = np.linspace(0.0, 20.0, 101)
    inflow = 1.0 + 0.8 * np.sign(np.sin(1.3 * times)) * np.sin(0.4 * times)

    def rate(t: float, h: Array) -> Array:
        into = np.append(np.interp(t, times, inflow), true[:-2:2] * h[:-1])
        return np.asarray(into - true[::2] * h - true[1::2] * h * np.abs(h))

    levels = solve_ivp(rate, (0.0, 20.0), np.zeros(TANKS), t_eval=times, rtol=1e-9, atol=1e-11).y
    outputs = []
    for i in SEEN:
        sigma = NOISE * float(np.std(levels[i]))
        noisy = levels[i] + sigma * generator.normal(size=len(times))
        outputs.append(ce.Output(f"y_h{i}", times, noisy, sigma=sigma))
    run = ce.Experiment("run", 0.0, 20.0, (ce.Input("u", times, inflow),), tuple(outputs))
    names = [f"{letter}{i}" for i in range(TANKS) for letter in ("a", "b")]
    off = 1.0 + generator.choice([-1.0, 1.0], 2 * TANKS) * generator.uniform(0.1, 0.6, 2 * TANKS)
    parameters = tuple(
        ce.Parameter(name, float(value * by), (0.1 * value, 10.0 * value))
        for name, value, by in zip(names, true, off, strict=True)
    )
    return ce.Problem(ce.read_model(fmu), parameters, (run,))


class CountedCosts:
    """The costs of all simulations, in the order in which they were asked for."""

    def __init__(self, problem: ce.Problem) -> None:
        self._residuals = ce.residuals(problem)
        self.costs: list[float] = []

    def __call__(self, x: Array) -> Array:
        found = np.asarray(self._residuals(x))
        self.costs.append(float(found @ found))
        return found


def of_scipy(problem: ce.Problem) -> list[float]:
    """Costs of SciPy's trust region method."""
    counted = CountedCosts(problem)
    start = np.array([p.start for p in problem.parameters])
    bounds = [p.lower for p in problem.parameters], [p.upper for p in problem.parameters]
    least_squares(counted, start, bounds=bounds, x_scale="jac")
    return counted.costs


def of_pymoo(problem: ce.Problem, most: int) -> list[float]:
    """Costs of pymoo's CMA-ES."""
    counted = CountedCosts(problem)
    lower = np.array([p.lower for p in problem.parameters])
    upper = np.array([p.upper for p in problem.parameters])

    class ScaledProblem(ElementwiseProblem):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(n_var=len(lower), n_obj=1, xl=0.0, xu=1.0)

        def _evaluate(self, x: Array, out: dict[str, float], *_: object, **__: object) -> None:
            out["F"] = float(np.sum(counted(lower * (upper / lower) ** x) ** 2))

    start = np.array([p.start for p in problem.parameters])
    first = np.log(start / lower) / np.log(upper / lower)
    minimize(ScaledProblem(), CMAES(x0=first, sigma=0.1), ("n_eval", most), seed=1)
    return counted.costs


def of_ours(problem: ce.Problem, options: dict[str, object]) -> list[float]:
    """Costs of all simulations of a fit, those before and after the search left out."""
    costs: list[float] = []

    def record(origin: object, outcome: object) -> None:
        if origin.search == "train" and outcome.residuals is not None:  # type: ignore[attr-defined]
            costs.append(float(outcome.residuals @ outcome.residuals))  # type: ignore[attr-defined]

    ce.fit(problem, ce.LeastSquares(**options), record=record)  # type: ignore[arg-type]
    return costs


def until(costs: list[float], best: float) -> float:
    """How many simulations it took to come within 5 % of the best cost; infinite if never."""
    near = np.flatnonzero(np.array(costs) <= CLOSE * best)
    return float(near[0] + 1) if len(near) else np.inf


@dataclass(frozen=True)
class WithoutForesight(Method):
    """Another method, to which no budget says that it is too short."""

    name: ClassVar[str] = "without_foresight"
    needs_residuals: ClassVar[bool] = True
    inner: Method

    def search(self, space: SearchSpace, generator: np.random.Generator) -> Search:
        requests = self.inner.search(space, generator)
        answers = None
        while True:
            try:
                points = next(requests) if answers is None else requests.send(answers)
            except StopIteration as end:
                return end.value  # type: ignore[no-any-return]
            answers = yield replace(points, follow_up=0)


def limited(budget: int) -> ce.Resources:
    return ce.Resources(workers=1, budget=ce.Budget(evaluations=budget))


def with_budget(fmu: Path, starts: int, budget: int) -> Iterator[Row]:
    """What the foresight of `least_squares` is worth at a budget."""
    for title, options in WAYS.items():
        method = ce.LeastSquares(**options)  # type: ignore[arg-type]
        found = []
        for seed in range(starts):
            problem = made_problem(fmu, seed)
            ways = (WithoutForesight(method), method)
            both = [ce.fit(problem, each, limited(budget)) for each in ways]
            found.append([x for r in both for x in (r.solution.cost, float(r.simulated))])
        before, simulated_before, after, simulated = np.array(found).T
        yield _ratios(title, after / before) | {
            "simulations": float(np.median(simulated)),
            "in place of": float(np.median(simulated_before)),
        }


def with_starts(fmu: Path, starts: int, budget: int) -> Row:
    """What the plan for a budget of many starts is worth."""
    ratios = []
    for seed in range(starts):
        problem = made_problem(fmu, seed)
        plan = Multistart(n=STARTS)
        planned = ce.fit(problem, ce.LeastSquares(), limited(budget), multistart=plan)
        space, alone = make_space(problem, (0,)), []
        for x in (space.start, *sample(space, STARTS - 1, plan)):
            values = space.estimates(x)
            begun = tuple(replace(p, start=values[p.name]) for p in problem.parameters)
            each = replace(problem, parameters=begun)
            found = ce.fit(each, ce.LeastSquares(), limited(budget // STARTS))
            alone.append(found.solution.cost)
        ratios.append(planned.solution.cost / min(alone))
    return _ratios(f"{STARTS} starts, planned or evenly", np.array(ratios))


def _ratios(title: str, ratios: Array) -> Row:
    return {"way": title, "cost times, median": float(np.median(ratios)),
            "least": float(ratios.min()), "most": float(ratios.max())}  # fmt: skip
