"""How many simulations of a dear model a fit of 20 parameters takes, beside SciPy and pymoo.

    python scripts/bench_dear_simulations.py [--starts 10] [--most 3000] [--budget 150]

The model is a chain of ten tanks, each with an outflow and a loss, 20 parameters in all, as an FMU
that is built here; three levels are measured with 1 % of noise. What counts is the number of
simulations until the cost is within 5 % of the best one that anybody finds; seconds do not: a
simulation of a second, most of it asleep, would be asked for as often. Printed is the median over
starts in which every parameter is 10 to 60 % off.

With `--budget`, only what `least_squares` makes of so many points: the cost at the end, beside that
of the same method which does not know that the budget has no room for a Jacobian and a step; and
that of ten starts among which the budget is planned, beside the best of ten that share it evenly.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
from build_fmus import build
from numpy.typing import NDArray
from pymoo.algorithms.soo.nonconvex.cmaes import CMAES
from pymoo.core.problem import ElementwiseProblem
from pymoo.optimize import minimize
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import cluster_est as ce
from cluster_est.methods.method import Method, Search
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.multistart import Multistart, sample

Array = NDArray[np.float64]
TANKS, NOISE, CLOSE = 10, 0.01, 1.05
STARTS = 10
SEEN = (2, 5, 9)
WAYS: dict[str, dict[str, object]] = {
    "ours, defaults": {},
    "ours, trials = 1, forward": {"trials": 1, "differences": "forward"},
    "ours, secant_updates = 20 too": {
        "trials": 1,
        "differences": "forward",
        "secant_updates": 20,
    },
}


def write_model(folder: Path) -> Path:
    """The sources of the chain of tanks."""
    lines = [
        'description = "A chain of ten tanks, each with an outflow and a loss"',
        "max_step = 0.05",
        "[experiment]",
        "stop = 20.0",
        "step = 0.2",
        "[units]",
        '"1" = {}',
        '"s" = { s = 1 }',
    ]

    def variable(name: str, **keys: object) -> None:
        lines.extend(["[[variable]]", f'name = "{name}"'])
        for key, value in keys.items():
            text = value if key in ("start", "derivative") else f'"{value}"'
            lines.append(f"{key} = {text}")

    for i in range(TANKS):
        for letter, start in (("a", 1.0), ("b", 0.1)):
            known = {"causality": "parameter", "variability": "tunable", "unit": "1"}
            variable(f"{letter}{i}", **known, start=start)
    variable("u", causality="input", start=0.0, unit="1")
    for i in range(TANKS):
        rate = f'{{ name = "der(h{i})", unit = "1", description = "rate of h{i}" }}'
        variable(f"h{i}", causality="local", start=0.0, unit="1", derivative=rate)
    for i in SEEN:
        variable(f"y{i}", causality="output", unit="1")
    equations = []
    for i in range(TANKS):
        inflow = "M(u)" if i == 0 else f"M(a{i - 1}) * M(h{i - 1})"
        equations.append(
            f"    M(der_h{i}) = {inflow} - M(a{i}) * M(h{i}) - M(b{i}) * M(h{i}) * fabs(M(h{i}));"
        )
    equations += [f"    M(y{i}) = M(h{i});" for i in SEEN]
    body = "\n".join(equations)
    model = folder / "tanks"
    model.mkdir()
    (model / "model.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (model / "model.c").write_text(
        '#include <math.h>\n\n#include "fmi2_model.h"\n\n'
        f"fmi2Status model_equations(Model *m)\n{{\n{body}\n    return fmi2OK;\n}}\n",
        encoding="utf-8",
    )
    return model


def made_problem(fmu: Path, seed: int) -> tuple[ce.Problem, Array]:
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
        outputs.append(ce.Output(f"y{i}", times, noisy, sigma=sigma))
    run = ce.Experiment("run", 0.0, 20.0, (ce.Input("u", times, inflow),), tuple(outputs))
    names = [f"{letter}{i}" for i in range(TANKS) for letter in ("a", "b")]
    off = 1.0 + generator.choice([-1.0, 1.0], 2 * TANKS) * generator.uniform(0.1, 0.6, 2 * TANKS)
    parameters = tuple(
        ce.Parameter(name, float(value * by), 0.1 * value, 10.0 * value)
        for name, value, by in zip(names, true, off, strict=True)
    )
    return ce.Problem(ce.read_model(fmu, names), parameters, (run,)), true


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

    class Scaled(ElementwiseProblem):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(n_var=len(lower), n_obj=1, xl=0.0, xu=1.0)

        def _evaluate(self, x: Array, out: dict[str, float], *_: object, **__: object) -> None:
            out["F"] = float(np.sum(counted(lower * (upper / lower) ** x) ** 2))

    start = np.array([p.start for p in problem.parameters])
    first = np.log(start / lower) / np.log(upper / lower)
    minimize(Scaled(), CMAES(x0=first, sigma=0.1), ("n_eval", most), seed=1)
    return counted.costs


def of_ours(problem: ce.Problem, options: dict[str, object]) -> list[float]:
    """Costs of all simulations of a fit, those before and after the search left out."""
    costs: list[float] = []

    def record(origin: object, outcome: object) -> None:
        if origin.search == "train" and outcome.residuals is not None:  # type: ignore[attr-defined]
            costs.append(float(outcome.residuals @ outcome.residuals))  # type: ignore[attr-defined]

    ce.fit(problem, ce.LeastSquares(**options), record=record)  # type: ignore[arg-type]
    return costs


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


def with_budget(fmu: Path, starts: int, budget: int) -> None:
    """Print what the foresight of `least_squares` is worth at a budget."""
    resources = ce.Resources(workers=1, budget=ce.Budget(evaluations=budget))
    for title, options in WAYS.items():
        method = ce.LeastSquares(**options)  # type: ignore[arg-type]
        rows = []
        for seed in range(starts):
            problem, _ = made_problem(fmu, seed)
            both = [ce.fit(problem, each, resources) for each in (WithoutForesight(method), method)]
            rows.append([x for r in both for x in (r.solution.cost, float(r.simulated))])
        before, simulated_before, after, simulated = np.array(rows).T
        ratios = after / before
        print(
            f"{title:32s} cost {np.median(ratios):.2f} times (median; {ratios.min():.2f} to "
            f"{ratios.max():.2f}), {np.median(simulated):.0f} simulations in place of "
            f"{np.median(simulated_before):.0f}"
        )


def with_starts(fmu: Path, starts: int, budget: int) -> None:
    """Print what the plan for a budget of many starts is worth."""
    ratios = []
    for seed in range(starts):
        problem, _ = made_problem(fmu, seed)
        resources = ce.Resources(workers=1, budget=ce.Budget(evaluations=budget))
        share = ce.Resources(workers=1, budget=ce.Budget(evaluations=budget // STARTS))
        planned = ce.fit(problem, ce.LeastSquares(), resources, multistart=Multistart(n=STARTS))
        space, alone = make_space(problem, (0,)), []
        for x in (space.start, *sample(space, STARTS - 1, Multistart(n=STARTS))):
            values = space.estimates(x)
            begun = tuple(replace(p, start=values[p.name]) for p in problem.parameters)
            found = ce.fit(replace(problem, parameters=begun), ce.LeastSquares(), share)
            alone.append(found.solution.cost)
        ratios.append(planned.solution.cost / min(alone))
    print(
        f"{f'{STARTS} starts, planned':32s} cost {np.median(ratios):.3g} times that of the best of "
        f"{STARTS} that share it evenly (median; {min(ratios):.3g} to {max(ratios):.3g})"
    )


def until(costs: list[float], best: float) -> float:
    """How many simulations it took to come within 5 % of the best cost; infinite if never."""
    near = np.flatnonzero(np.array(costs) <= CLOSE * best)
    return float(near[0] + 1) if len(near) else np.inf


def main() -> None:
    """Print the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--most", type=int, default=3000, help="simulations of pymoo")
    parser.add_argument("--budget", type=int, default=0, help="points, for least_squares alone")
    given = parser.parse_args()
    if given.budget:
        with tempfile.TemporaryDirectory() as folder:
            fmu = build(write_model(Path(folder)), Path(folder))
            with_budget(fmu, given.starts, given.budget)
            with_starts(fmu, given.starts, given.budget)
        return
    ways: dict[str, Callable[[ce.Problem], list[float]]] = {
        name: partial(of_ours, options=options) for name, options in WAYS.items()
    }
    ways["SciPy least_squares"] = of_scipy
    ways["pymoo CMA-ES"] = lambda problem: of_pymoo(problem, given.most)
    counts: dict[str, list[float]] = {name: [] for name in ways}
    totals: dict[str, list[int]] = {name: [] for name in ways}
    with tempfile.TemporaryDirectory() as folder:
        fmu = build(write_model(Path(folder)), Path(folder))
        for seed in range(given.starts):
            problem, _ = made_problem(fmu, seed)
            found = {name: way(problem) for name, way in ways.items()}
            best = min(min(costs) for costs in found.values())
            for name, costs in found.items():
                counts[name].append(until(costs, best))
                totals[name].append(len(costs))
    for name, reached in counts.items():
        never = sum(not np.isfinite(each) for each in reached)
        print(
            f"{name:32s} {np.median(reached):6.0f} simulations (median; {never} of {given.starts} "
            f"never); {np.median(totals[name]):.0f} in all"
        )


if __name__ == "__main__":
    main()
