import hashlib
import os
import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.problems.constrained import CONSTRAINED, TOTAL
from support.problems.functions import (
    FunctionExecutor,
    FunctionProblem,
    followed,
    named,
    rosenbrock,
)
from support.thinning import thinned

from cluster_est import Budget, Experiment, Model, Output, Parameter, Problem, Solver
from cluster_est.errors import ProblemError
from cluster_est.methods import (
    SEARCH_METHODS,
    Cmaes,
    DifferentialEvolution,
    GeneticAlgorithm,
    Isres,
    Method,
    Nsga2,
    ParticleSwarm,
)
from cluster_est.methods.method import Ending, Solution
from cluster_est.problem.costs import SoftL1, SumAbsolute, SumSquared
from cluster_est.problem.search_space import make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Outcome, Status, Task, UserFunction

SHIFT = np.array([0.3, -0.7, 0.11])


def rastrigin(x):
    z = x - SHIFT
    return np.array([np.add.reduce(z * z - 10.0 * np.cos(2.0 * np.pi * z) + 10.0)])


def ackley(x):
    z = x - SHIFT
    far = 20.0 - 20.0 * np.exp(-0.2 * np.sqrt(np.mean(z * z)))
    return np.array([far + np.e - np.exp(np.mean(np.cos(2.0 * np.pi * z)))])


ROSENBROCK = FunctionProblem("rosenbrock", rosenbrock, (-1.2, 1.0), 0.0, (-2, -2), (2.5, 3.5))
ON_A_BOUND = FunctionProblem("bound", rosenbrock, (-1.2, 1.0), 0.25, (-2.0, -2.0), (0.5, 2.0))
RASTRIGIN = FunctionProblem(
    "rastrigin", rastrigin, (3.3, -2.7, 1.2), 0.0, (-5.12,) * 3, (5.0,) * 3, cost=TOTAL
)
ACKLEY = FunctionProblem(
    "ackley", ackley, (10.3, -2.7, 11.2), 0.0, (-15.0,) * 3, (20.0,) * 3, cost=TOTAL
)
HS11 = replace(named("hs11", CONSTRAINED), lower=(-10.0,) * 2, upper=(10.0,) * 2)
HS7 = replace(named("hs7", CONSTRAINED), lower=(-3.0,) * 2, upper=(3.0,) * 2)
MINIMA = [
    (ParticleSwarm(), ON_A_BOUND, 1e-9),
    (ParticleSwarm(), RASTRIGIN, 1e-8),
    (ParticleSwarm(adaptive=True), ACKLEY, 1e-4),
    (DifferentialEvolution(base="best"), ROSENBROCK, 1e-10),
    (DifferentialEvolution(), ACKLEY, 1e-4),
    (Cmaes(), ACKLEY, 1e-4),
    (GeneticAlgorithm(), RASTRIGIN, 1e-2),  # few digits, as its docstring says
    (Isres(), ACKLEY, 1e-4),
]
"""(method, problem, how far its cost may be from the minimum), besides those of the contract"""
SMALL = [
    *(
        kind(population=12, max_generations=15)
        for kind in (DifferentialEvolution, Cmaes, ParticleSwarm, GeneticAlgorithm)
    ),
    Isres(population=14, max_generations=15),
]


def two_outputs(x):
    """Distances to A and to B, as the residuals of two outputs."""
    return np.concatenate([x - A, x - B])


A, B = np.array([0.0, 0.5, 0.0]), np.array([1.0, 0.5, 1.0])


def two_objectives(experiments=1, cost=None, outputs=("y", "z"), **more):
    times = np.arange(1.0, len(A) + 1.0)
    made = tuple(Output(name, times, 0.0 * times) for name in outputs)
    parts = [made] if experiments == 1 else [(output,) for output in made]
    chosen = tuple(Experiment(f"e{i}", 0.0, 9.0, (), part, **more) for i, part in enumerate(parts))
    parameters = tuple(Parameter(f"x{i}", 1.5, (-2.0, 3.0)) for i in range(len(A)))
    model = Model("none", b"", "model_exchange", Solver("rk4"), tuple(p.name for p in parameters))
    return Problem(model, parameters, chosen, cost or SumSquared())


def solve(problem, method, residuals=None, seed=0, executor=None):
    space = make_space(problem, tuple(range(len(problem.experiments))))
    runner = Runner(executor or FunctionExecutor(residuals))
    return runner.run([SearchRequest("test", method, space, seed)])[0]


@pytest.mark.parametrize(
    ("method", "problem", "tolerance"),
    thinned(
        [pytest.param(*case, id=f"{case[0].name}-{case[1].name}") for case in MINIMA],
        lambda method, problem, tolerance: method.name,
    ),
)
def test_finds_the_minimum(method, problem, tolerance):
    solution = problem.solve(method, seed=1)
    assert solution.cost == pytest.approx(problem.minimum, abs=tolerance)
    assert solution.at.cost == solution.cost


@pytest.mark.parametrize("method", SMALL, ids=lambda m: m.name)
class TestPopulation:
    def test_a_generation_is_one_request_and_the_start_is_in_the_first(self, method):
        found = followed(ROSENBROCK, method)
        requests = found.requests
        assert found.solution.iterations == len(requests) == method.max_generations
        extra = 1 if method.name == "cmaes" else 0  # the start, on top of the sample
        sizes = [len(points.x) for points in requests]
        assert sizes == [method.population + extra] + [method.population] * 14
        assert requests[0].x[0].tolist() == list(ROSENBROCK.start)
        assert {points.purpose for points in requests} == {"generation"}

    def test_the_table_has_a_line_for_each_generation(self, method):
        lines = [points.progress for points in followed(HS11, method).requests[1:]]
        assert [line.iteration for line in lines] == list(range(1, 15))
        ranks = [(line.violation, line.cost) for line in lines]
        assert ranks == sorted(ranks, reverse=True)
        assert all(line.step > 0.0 for line in lines)

    def test_another_seed_is_another_search(self, method):
        first, other = (followed(HS11, method, seed).requests for seed in (3, 4))
        assert first[1].x.tobytes() != other[1].x.tobytes()

    def test_searches_side_by_side_do_not_disturb_each_other(self, method):
        space = ROSENBROCK.space()
        requests = [SearchRequest(str(seed), method, space, seed) for seed in range(3)]
        with FunctionExecutor(rosenbrock) as executor:
            together = Runner(executor).run(requests)
        alone = [ROSENBROCK.solve(method, seed) for seed in range(3)]
        assert [s.x.tobytes() for s in together] == [s.x.tobytes() for s in alone]

    def test_leaves_the_global_generators_alone(self, method):
        before = np.random.get_state()[1].copy(), random.getstate()
        ROSENBROCK.solve(method)
        assert (np.random.get_state()[1] == before[0]).all()
        assert random.getstate() == before[1]

    def test_failures_are_worse_than_anything(self, method):
        def walled(x):
            return rosenbrock(x) if x[0] > -1.0 and x[1] < 2.0 else np.full(2, np.nan)

        # the start fails too
        solution = replace(ROSENBROCK, residuals=walled).solve(replace(method, max_generations=60))
        assert solution.at.ok
        assert solution.cost < 0.1

    def test_says_what_to_raise_at_its_limit(self, method):
        solution = ROSENBROCK.solve(method)
        assert solution.ending is Ending.MAX_ITERATIONS
        assert "after 15 generations; raise method.options.max_generations" in solution.message

    def test_says_by_how_much_constraints_are_violated_at_best(self, method):
        # x0 <= 1 and x0 >= 2 contradict each other; the least of the larger violation is 0.5
        held = replace(ROSENBROCK, equality=(False, False))
        contradiction = replace(held, constraints=lambda x: np.array([x[0] - 1.0, 2.0 - x[0]]))
        solution = contradiction.solve(replace(method, max_generations=40))
        assert solution.ending is Ending.INFEASIBLE
        assert "violates them by 0.5" in solution.message
        assert solution.x[0] == pytest.approx(1.5, abs=0.1)

    def test_ends_where_nothing_changes_the_cost(self, method):
        flat = replace(ROSENBROCK, residuals=lambda x: np.ones(2))
        solution = flat.solve(replace(method, max_generations=500, window=5))
        assert solution.ending is Ending.CONVERGED
        assert solution.cost == 2.0

    def test_one_unknown_is_enough(self, method):
        line = FunctionProblem("line", lambda x: x - 0.3, (0.9,), 0.0, (0.0,), (1.0,))
        solution = line.solve(replace(method, max_generations=40))
        assert solution.x[0] == pytest.approx(0.3, abs=1e-2)

    def test_refuses_a_population_that_is_too_small(self, method):
        space = ROSENBROCK.space()
        with pytest.raises(ProblemError, match=r"options\.population: must be at least .* is 3"):
            replace(method, population=3).check(space)

    def test_refuses_equalities_that_it_cannot_keep(self, method):
        space = HS7.space()
        if method.name == "isres":
            method.check(space)
            return
        with pytest.raises(ProblemError, match=r'must be inequalities .* "isres"'):
            method.check(space)

    def test_needs_bounds_unless_it_is_cmaes(self, method):
        half = replace(ROSENBROCK, lower=(-2.0, -2.0), upper=(2.5, np.inf))
        problem = two_objectives()
        first = Parameter("x0", 1.5, (0.0, 3.0), scale="log")
        scaled = make_space(replace(problem, parameters=(first, *problem.parameters[1:])), (0,))
        if method.name == "cmaes":
            assert half.solve(Cmaes()).cost == pytest.approx(0.0, abs=1e-10)
            method.check(scaled)
            return
        with pytest.raises(ProblemError, match=r"parameters\.x1\.bounds: .* are \[-2, inf\]; set"):
            method.search(half.space(), np.random.default_rng(0))
        with pytest.raises(ProblemError, match=r"x0\.bounds: must be finite .* and positive"):
            method.check(scaled)


def test_an_infinite_cost_is_no_more_than_a_bad_one():
    def steep(x):
        return rosenbrock(x) * (1e200 if x[0] < 0.0 else 1.0)

    for method in SMALL:
        assert np.isfinite(replace(ROSENBROCK, residuals=steep).solve(method).cost)


def fingerprints():
    """Of all points that each method asks for, with failures and constraints among them."""

    def walled(x):
        return rosenbrock(x) if x[1] < 2.0 else np.full(2, np.nan)

    found = []
    for problem in (HS11, replace(ROSENBROCK, residuals=walled)):
        for method in SMALL:
            points = followed(problem, replace(method, max_generations=5), seed=7).points
            found.append(hashlib.sha256(points.tobytes()).hexdigest())
    front = solve(two_objectives(), Nsga2(population=20, max_generations=5), two_outputs)
    return [*found, front.x.tobytes().hex()]


@pytest.mark.slow
def test_a_new_process_gets_the_same_bits():
    code = "import test_populations; print(*test_populations.fingerprints())"
    command = [sys.executable, "-W", "error", "-c", code]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONHASHSEED": "5"}
    found = subprocess.check_output(command, env=env, cwd=Path(__file__).parent, text=True)
    assert found.split() == fingerprints()


def test_importing_the_methods_does_not_import_pymoo():
    modules = ["cmaes", "nsga2", "population_method", "pymoo_methods"]
    imports = "; ".join(f"import cluster_est.methods.populations.{name}" for name in modules)
    code = f"import sys; {imports}; print('pymoo' in sys.modules, 'cma' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["False", "False"]


class TestNsga2:
    """F0 = |x - A|^2 and F1 = |x - B|^2: the front is sqrt(F0) + sqrt(F1) = |B - A|."""

    DISTANCE = float(np.sqrt(2.0))

    def test_finds_the_whole_front(self):
        solution = solve(two_objectives(), Nsga2(), two_outputs)
        assert solution.ending is Ending.CONVERGED
        roots = np.sqrt([other.objectives for other in solution.others])
        assert len(roots) >= 90
        assert (roots.sum(axis=1) - self.DISTANCE < 0.08).all()
        along = np.sort(roots[:, 0]) / self.DISTANCE
        assert along[0] < 0.05
        assert along[-1] > 0.95
        assert np.diff(along).max() < 0.06

    def test_the_solution_is_the_point_of_least_total_cost_and_none_beats_another(self):
        solution = solve(two_objectives(), Nsga2(max_generations=20), two_outputs)
        # the least total is halfway between A and B
        assert solution.x == pytest.approx((A + B) / 2.0, abs=0.1)
        assert solution.cost == pytest.approx(1.0, abs=0.02)
        assert solution.others[0].x.tolist() == solution.x.tolist()
        costs = [other.cost for other in solution.others]
        assert costs == sorted(costs)
        assert costs[0] == solution.cost
        values = np.array([other.objectives for other in solution.others])
        for mine in values:
            others = values[(values != mine).any(axis=1)]
            assert not (others <= mine).all(axis=1).any()
        for other in solution.others:
            parts = [np.sum((other.x - A) ** 2), np.sum((other.x - B) ** 2)]
            assert other.objectives == pytest.approx(parts)
            assert other.cost == pytest.approx(sum(parts))

    def test_experiments_kept_apart_are_the_same_front(self):
        class Split(FunctionExecutor):
            def _answer(self, task):
                outcome = super()._answer(task)
                part = slice(0, 3) if task.experiment == 0 else slice(3, 6)
                return replace(outcome, residuals=outcome.residuals[part])

        method = Nsga2(population=20, max_generations=8)
        apart = replace(method, objectives="experiments")
        found = solve(two_objectives(experiments=2), apart, executor=Split(two_outputs))
        expected = solve(two_objectives(), method, two_outputs)
        assert len(expected.others) > 1
        assert [o.objectives for o in found.others] == [o.objectives for o in expected.others]

    def test_an_objective_is_the_problem_s_cost_of_its_part(self):
        problem = two_objectives(cost=SumAbsolute())
        solution = solve(problem, Nsga2(population=20, max_generations=5), two_outputs)
        assert len(solution.others) > 1
        for other in solution.others:
            parts = [np.abs(other.x - A).sum(), np.abs(other.x - B).sum()]
            assert other.objectives == pytest.approx(parts)

    def test_constraints_cut_the_front(self):
        # x0 <= 0.5 leaves the half of the segment that is nearer to A
        problem = two_objectives(constraint_functions=(UserFunction("none", "c"),))
        executor = FunctionExecutor(two_outputs, lambda x: np.array([x[0] - 0.5]))
        found = solve(problem, Nsga2(), executor=executor)
        assert found.at.feasible
        assert max(other.x[0] for other in found.others) <= 0.5 + 1e-6
        roots = np.sqrt([other.objectives for other in found.others])
        assert (roots[:, 0] / self.DISTANCE).min() < 0.05

    def test_same_seed_same_bits_also_with_failures(self):
        def walled(x):
            return two_outputs(x) if x[1] < 0.6 else np.full(6, np.nan)

        method = Nsga2(population=20, max_generations=12)
        first, again, other = (solve(two_objectives(), method, walled, s) for s in (5, 5, 6))
        assert [o.x.tobytes() for o in first.others] == [o.x.tobytes() for o in again.others]
        assert first.x.tobytes() != other.x.tobytes()
        assert max(o.x[1] for o in first.others) < 0.6

    def test_objectives_that_agree_make_a_single_point(self):
        method = Nsga2(population=40, max_generations=60)
        solution = solve(two_objectives(), method, lambda x: np.kron([1.0, 2.0], x - A))
        assert len(solution.others) == 1
        assert solution.others[0].x == pytest.approx(A, abs=0.05)

    def test_refuses_a_single_objective(self):
        space = make_space(two_objectives(), (0,))
        Nsga2().check(space)
        with pytest.raises(ProblemError, match=r"at least two experiments .* there is one"):
            Nsga2(objectives="experiments").check(space)
        single = make_space(two_objectives(outputs=("y",)), (0,))
        with pytest.raises(ProblemError, match=r"at least two outputs .* there is one"):
            Nsga2().check(single)

    def test_refuses_outputs_of_cost_functions(self):
        problem = two_objectives(experiments=2, cost_function=UserFunction("none", "f"))
        space = make_space(problem, (0, 1))
        with pytest.raises(ProblemError, match='must be "experiments" if'):
            Nsga2().check(space)
        Nsga2(objectives="experiments").check(space)


BEALE = replace(named("beale"), lower=(-4.5, -4.5), upper=(4.5, 4.5))
DENNIS = replace(named("brown dennis"), lower=(-30.0,) * 4, upper=(30.0,) * 4)


class EarlyExecutor(FunctionExecutor):
    """Ends whatever is above its bound, and counts."""

    ended = 0

    def _answer(self, task: Task) -> Outcome:
        outcome = super()._answer(task)
        if outcome.residuals is None or not float(np.sum(outcome.residuals**2)) > task.bound:
            return outcome
        self.ended += 1
        return Outcome(task.id, Status.ENDED_EARLY, message="its sum was above the bound")


def solved(problem: FunctionProblem, method: Method) -> tuple[Solution, Runner, int]:
    """The solution, who ran it and how many simulations ended early."""
    executor = EarlyExecutor(problem.residuals, problem.constraints)
    runner = Runner(executor, Budget(evaluations=600))
    (solution,) = runner.run([SearchRequest("test", method, problem.space(), 3)])
    return solution, runner, executor.ended


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("de", {}, BEALE),
        ("pso", {"population": 12}, DENNIS),
        ("pso", {"adaptive": True}, DENNIS),
        ("ga", {"population": 12}, BEALE),
    ],
)
def test_the_result_is_the_same(name, options, problem):
    whole, all_of_it, _ = solved(problem, SEARCH_METHODS[name](**options))
    early, runner, ended = solved(problem, SEARCH_METHODS[name](**options, early_end=True))
    assert ended > 100
    assert early.x.tobytes() == whole.x.tobytes()
    assert (early.cost, early.ending, early.message) == (whole.cost, whole.ending, whole.message)
    assert early.iterations == whole.iterations
    assert runner.evaluations == all_of_it.evaluations
    assert runner.failures == 0


@pytest.mark.parametrize("name", ["de", "pso", "ga"])
def test_no_bound_without_the_option_or_with_another_cost_or_constraints(name):
    robust = replace(BEALE, cost=SoftL1())
    held = replace(BEALE, constraints=lambda x: np.array([x[0] - 4.0]), equality=(False,))
    on = SEARCH_METHODS[name](early_end=True)
    for problem, method in ((BEALE, SEARCH_METHODS[name]()), (robust, on), (held, on)):
        assert solved(problem, method)[2] == 0
