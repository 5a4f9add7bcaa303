"""Residuals that are reduced before they are sent change nothing but how much is sent."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.problems.answering import reduced
from support.problems.curves import CurveExecutor, Curves
from support.problems.method_entries import ENTRIES
from support.problems.springs import spring_problem
from support.thinning import thinned

from cluster_est import Budget, Experiment, Multistart, Output, Parameter, fit
from cluster_est.methods import (
    SEARCH_METHODS,
    DifferentialEvolution,
    LeastSquares,
    Nsga2,
    PatternSearch,
)
from cluster_est.methods.method import GivenPoints
from cluster_est.problem.costs import COSTS
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.multistart import search_from_starts
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.evaluate import Evaluator
from workers.messages import REDUCTIONS, Curve, SignalBound, Task, UserFunction
from workers.wire import TaskBatch

REDUCIBLE = {name: cost for name, cost in COSTS.items() if cost.reduction is not None}
COUNTS = (7, 0, 1, 13)
RESIDUALS = arrays(np.float64, sum(COUNTS), elements=st.floats(-1e6, 1e6))
TIMES = np.linspace(0.1, 3.0, 30)
SLOW = pytest.mark.slow


def test_only_sums_over_residuals_can_be_reduced():
    assert set(REDUCIBLE) == {"sse", "sae"}, (
        "a cost that sums something else over residuals has no `reduction`; one that sums squares "
        "or absolute values is named here and in test_the_cost_says_how"
    )


@pytest.mark.parametrize("cost", REDUCIBLE.values(), ids=lambda cost: cost.name)
@given(residuals=RESIDUALS)
def test_a_cost_is_the_same(cost, residuals):
    found = reduced(residuals, COUNTS, cost.reduction)
    power = 2 if cost.name == "sse" else 1
    truth = math.fsum(abs(r) ** power for r in residuals.tolist())
    assert cost().value(found, np.arange(3)) == pytest.approx(truth, rel=1e-12, abs=1e-300), (
        "`value` must be the same of one reduced number for each output: else set no reduction"
    )


def experiment(*samples: int, **more: object) -> Experiment:
    outputs = tuple(
        Output(f"y{i}", np.arange(1.0, n + 1.0), np.zeros(n)) for i, n in enumerate(samples)
    )
    return Experiment("e", 0.0, 100.0, (), outputs, **more)  # type: ignore[arg-type]


def space_of(*experiments: Experiment, cost: str = "sse") -> SearchSpace:
    """As a method gets it that looks at no residual."""
    named = tuple(replace(each, id=f"e{i}") for i, each in enumerate(experiments))
    problem = replace(decays(cost).problem(), experiments=named)
    return replace(make_space(problem, tuple(range(len(experiments)))), reduced=True)


class TestWant:
    def test_it_must_save_something(self):
        samples = (10, 10), (10, 11), (0, 11, 0)
        wants = space_of(*(experiment(*each) for each in samples)).wants
        assert wants == ("residuals", "squares", "squares")

    @pytest.mark.parametrize("name", COSTS)
    def test_the_cost_says_how(self, name):
        expected = {"sse": "squares", "sae": "absolutes"}.get(name, "residuals")
        assert space_of(experiment(50), cost=name).wants == (expected,), "name its reduction here"

    def test_what_a_function_returns_is_left_alone(self):
        own = experiment(50, cost_function=UserFunction("none", "cost"))
        assert space_of(own).wants == ("residuals",)

    def test_the_space_says_what_is_of_which_output(self):
        space = space_of(experiment(3), *decays("sse").problem().experiments)
        assert space.wants == ("residuals", "squares", "squares")
        assert space.outputs.tolist() == [0, 0, 0, 0, 1, 0, 1]
        assert [rows.stop for rows in space.rows] == [3, 5, 7]


def decays(cost: str) -> Curves:
    """Two experiments with two outputs each, which do not agree on the parameters."""

    def formula(times, values, e):
        rise, rate = values
        return np.array([rise * np.exp(-rate * times), rise * rate * times / (1.0 + times)])

    noise = np.random.default_rng(5).normal(size=(2, 2, len(TIMES)))
    true = np.array([2.0, 0.7]), np.array([1.7, 0.9])
    measured = [formula(TIMES, true[e], e) + 0.1 * noise[e] for e in range(2)]
    parameters = (Parameter("rise", 1.0, (0.1, 5.0)), Parameter("rate", 0.3, (0.05, 3.0)))
    return Curves(formula, parameters, TIMES, measured, cost=COSTS[cost]())


BLIND = [entry for entry in ENTRIES if not entry.method.needs_every_residual]


def test_methods_that_work_on_residuals_get_them_all():
    for method in SEARCH_METHODS.values():
        assert method.needs_every_residual or not method.needs_residuals, (
            f"{method.name} works on residuals: leave out its needs_every_residual = False"
        )


def seeing_all(method):
    """The same method, but one that is given every residual."""
    kind = type(method)
    seeing = type(kind.__name__, (kind,), {"needs_every_residual": True})
    return seeing(**{each.name: getattr(method, each.name) for each in fields(method)})


@pytest.mark.parametrize(
    ("entry", "cost"),
    thinned(
        [pytest.param(e, cost, id=f"{e}-{cost}") for e in BLIND for cost in REDUCIBLE],
        lambda entry, cost: str(entry),
        lambda entry, cost: cost,
    ),
)
def test_a_method_goes_the_same_way(entry, cost):
    """Bit by bit, because 16 equal residuals of an output make the same sum either way."""

    def formula(times, values, e):
        x, y = values
        heights = 1.0 + (y - x**2) ** 2 + 0.1 * (1.0 - x) ** 2, 0.5 + (x - 0.2) ** 2 + y**2
        outputs = heights if entry.method.name == "nsga2" else heights[:1]
        return np.array([np.full(16, np.sqrt(height)) for height in outputs])

    parameters = (Parameter("x", -1.2, (-2.0, 2.0)), Parameter("y", 1.0, (-1.5, 2.5)))
    outputs = 2 if entry.method.name == "nsga2" else 1
    measured = [np.zeros((outputs, 16))]
    curves = Curves(formula, parameters, np.arange(16.0), measured, cost=COSTS[cost]())
    ways = []
    for method in (seeing_all(entry.method), entry.method):
        asked, sizes = [], set()

        def record(origin, outcome, asked=asked, sizes=sizes):
            asked.append(origin.task.values.tolist())
            sizes.add(len(outcome.residuals))

        runner = Runner(CurveExecutor(curves), Budget(evaluations=400), record)
        (found,) = runner.run([SearchRequest("test", method, curves.space(), 3)])
        assert sizes == {outputs if method is entry.method else 16 * outputs}
        ways.append((asked, found.ending, found.iterations))
    assert len(ways[0][0]) > 50
    assert ways[0] == ways[1], (
        "it goes another way where residuals are reduced: look at `cost` alone, or leave out "
        "needs_every_residual = False"
    )


@pytest.mark.parametrize("kind", ["outputs", "experiments"])
def test_objectives_are_kept_apart(kind):
    method = Nsga2(objectives=kind, population=20, max_generations=5)
    fronts = [decays("sse").solve(each)[2].others for each in (seeing_all(method), method)]
    assert len(fronts[0]) == len(fronts[1]) > 2
    for one, other in zip(*fronts, strict=True):
        np.testing.assert_allclose(one.objectives, other.objectives, rtol=1e-12)


def test_whole_and_reduced_answers_do_not_stand_in_for_each_other():
    """Else bits of a search would depend on which other search was faster."""
    curves, asked = decays("sse"), []
    runner = Runner(
        CurveExecutor(curves),
        record=lambda origin, _: asked.append((origin.search, origin.task.want)),
    )
    look = GivenPoints(curves.space().start[None, :], "whole")
    search = PatternSearch(max_iterations=1)
    for method in (look, search, look, search):
        runner.run([SearchRequest(method.name, method, curves.space())])
    wants = {"look": "residuals", "pattern_search": "squares"}
    assert all(want == wants[name] for name, want in asked)
    assert [name for name, _ in asked].count("look") == 2, "the second look is remembered"
    together = len(asked)
    runner = Runner(CurveExecutor(curves))
    runner.run([SearchRequest("alone", search, curves.space())])
    assert together == 2 + runner.simulations, "the searches are not spared anything either"


class TestWorker:
    """A simulation is the same, whatever is sent of it."""

    @pytest.fixture
    def evaluator(self):
        problem = spring_problem(experiments=1, samples=150).problem
        run = problem.experiments[0]
        (output,) = run.outputs
        empty = replace(output, variable="v", times=np.zeros(0), values=np.zeros(0))
        bound = SignalBound("limit", "v", run.outputs[0].times[:9], np.full(9, -1.0), np.ones(9))
        points = np.column_stack([output.values, output.values])[:20]
        curve = Curve(("y", "v"), points, output.times[:40])
        run = replace(run, outputs=(empty, output), bounds=(bound,), curve=curve)
        found = Evaluator(problem.model, (run,), "worker")
        yield found, run
        found.close()

    @pytest.mark.parametrize("want", REDUCTIONS)
    def test_an_answer_has_a_number_for_each_output_and_whole_constraints(self, evaluator, want):
        worker, run = evaluator
        values = np.array([[1.0 + 0.1 * i, 20.0, 0.5, 0.01 * i] for i in range(4)])
        values[2, 0] = -1.0  # a mass that the model refuses
        answers = {
            each: worker.evaluate(
                TaskBatch.of([Task(i, 0, row, each) for i, row in enumerate(values)])
            )
            for each in ("residuals", want)
        }
        assert run.counts == (0, 150, 19)
        for whole, short in zip(answers["residuals"], answers[want], strict=True):
            assert (whole.status, whole.message) == (short.status, short.message)
            if not whole.ok:
                assert short.residuals is None
                continue
            parts = whole.residuals[:150], whole.residuals[150:]
            norm = 2 if want == "squares" else 1
            truth = [np.linalg.norm(part, norm) for part in parts]
            np.testing.assert_allclose(short.residuals, truth, rtol=1e-12)
            assert whole.constraints.tobytes() == short.constraints.tobytes()
        alone = worker.evaluate(TaskBatch.of([Task(3, 0, values[3], want)]))[0]
        assert alone.residuals.tobytes() == answers[want][3].residuals.tobytes()


class TestFit:
    METHOD = DifferentialEvolution(population=12, max_generations=6)

    @pytest.mark.parametrize("starts", [1, pytest.param(3, marks=SLOW)])
    def test_solutions_have_every_residual(self, starts):
        truth = spring_problem(experiments=2, noise=0.01)
        train, test = truth.problem.experiments
        problem = replace(truth.problem, experiments=(train, replace(test, role="test")))
        result = fit(problem, self.METHOD, multistart=Multistart(starts))
        for solution in (result.solution, result.test_solution):
            residuals = solution.at.residuals
            assert len(residuals) == 150
            assert solution.cost == solution.at.cost
            assert solution.cost == pytest.approx(math.fsum((residuals**2).tolist()), rel=1e-12)
        assert result.cost == result.solution.cost
        assert all(np.isfinite(e.std_error) for e in result.estimates if e.label == "m")

    @pytest.mark.parametrize("method", [METHOD, LeastSquares()], ids=lambda m: m.name)
    def test_points_that_only_compete_are_asked_for_like_those_that_follow(self, method):
        """So that the start of a search, which was among them, is remembered."""
        curves, wants = decays("sse"), []
        runner = Runner(
            CurveExecutor(curves), record=lambda origin, _: wants.append(origin.task.want)
        )
        search_from_starts(runner, curves.space(), method, Multistart(2, screen=4), 0)
        assert set(wants) == {"squares" if method is self.METHOD else "residuals"}
