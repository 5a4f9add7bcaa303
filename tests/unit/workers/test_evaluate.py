import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st
from support.truth.example_models import MODELS, REFERENCES, sampled_experiment

from workers import evaluate
from workers.evaluate import Evaluator
from workers.messages import (
    Effect,
    Experiment,
    Input,
    Interface,
    Model,
    Output,
    Solver,
    Status,
    Task,
)
from workers.wire import TaskBatch

SOLVERS: dict[str, tuple[Interface, Solver]] = {
    "dormand_prince": ("model_exchange", Solver("dormand_prince")),
    "rk4": ("model_exchange", Solver("rk4", 0.02)),
    "cvode": ("model_exchange", Solver("cvode")),
    "fmu": ("co_simulation", Solver("fmu")),
}
EXPERIMENTS = tuple(
    sampled_experiment(REFERENCES["mass_spring_damper"], interpolation, seed)
    for seed, interpolation in enumerate(["linear", "hold", "linear"])
)
POINTS = np.array(
    [[1.0, 25.0], [-1.0, 25.0], [1.5, 30.0], [np.nan, 1.0], [0.0, 9.0], [2.0, np.inf], [0.7, 80.0]]
)


ARCHIVE = (MODELS / "mass_spring_damper.fmu").read_bytes()


@cache
def evaluator(solver):
    return fresh(solver)


def fresh(name, experiments=EXPERIMENTS, **options):
    interface, solver = SOLVERS[name]
    model = Model("mass.fmu", ARCHIVE, interface, replace(solver, **options), ("m", "k"))
    return Evaluator(model, experiments, "test")


def ask(to, tasks, want="residuals"):
    """Outcomes of (experiment, values), with ids that are not places."""
    packed = [Task(100 + 7 * i, e, values, want) for i, (e, values) in enumerate(tasks)]
    outcomes = to.evaluate(TaskBatch.of(packed))
    assert [o.task for o in outcomes] == [task.id for task in packed]
    return outcomes


def bits(outcome):
    """All of an outcome but what may differ: its id, its seconds and its worker."""
    residuals, trajectory = outcome.residuals, outcome.trajectory
    return (
        outcome.status,
        outcome.message,
        b"" if residuals is None else residuals.tobytes(),
        b"" if trajectory is None else trajectory.times.tobytes() + trajectory.values.tobytes(),
    )


@cache
def alone(solver, experiment, point):
    return bits(ask(evaluator(solver), [(experiment, POINTS[point])])[0])


@pytest.mark.parametrize("solver", list(SOLVERS))
class TestEverySolver:
    @limits(max_examples=6)
    @given(
        st.lists(
            st.tuples(st.integers(0, len(EXPERIMENTS) - 1), st.integers(0, len(POINTS) - 1)),
            min_size=1,
            max_size=25,
        )
    )
    def test_answers_do_not_depend_on_the_batch_or_its_order(self, solver, chosen):
        outcomes = ask(evaluator(solver), [(e, POINTS[p]) for e, p in chosen])
        assert [bits(o) for o in outcomes] == [alone(solver, e, p) for e, p in chosen]

    def test_neither_a_memory_limit_nor_another_evaluator_leaves_a_trace(self, solver, monkeypatch):
        tasks = [(e, point) for point in POINTS for e in range(len(EXPERIMENTS))]
        whole = [bits(o) for o in ask(evaluator(solver), tasks, "trajectory")]
        monkeypatch.setattr(evaluate, "MAX_VALUES", 250)
        new = fresh(solver)
        for _ in range(2):
            assert [bits(o) for o in ask(new, tasks, "trajectory")] == whole
        new.close()
        new.close()

    def test_failures_leave_the_rest_of_their_batch_alone(self, solver):
        outcomes = ask(evaluator(solver), [(0, point) for point in POINTS])
        assert [o.ok for o in outcomes] == [True, False, True, False, False, False, True]
        for outcome in outcomes:
            assert (outcome.residuals is None) == (not outcome.ok) == bool(outcome.message)
            assert outcome.trajectory is None
            assert outcome.worker == "test"
        for place, mass in ((1, "-1"), (3, "nan"), (4, "0")):
            assert outcomes[place].status is Status.SOLVER_FAILURE
            start = rf"initialised at t = {EXPERIMENTS[0].start:.9g} s"
            said = f"the FMU said: mass must be positive, got {mass}"
            assert re.search(f"{start}.*{said}$", outcomes[place].message)

    def test_trajectory_and_residuals_tell_the_same(self, solver):
        for e, experiment in enumerate(EXPERIMENTS):
            (outcome,) = ask(evaluator(solver), [(e, POINTS[0])], "trajectory")
            (bare,) = ask(evaluator(solver), [(e, POINTS[0])])
            (output,) = experiment.outputs
            assert outcome.trajectory.variables == ("y",)
            at = np.searchsorted(outcome.trajectory.times, output.times)
            simulated = outcome.trajectory.values[at, 0]
            expected = (output.values - simulated) / output.sigma
            np.testing.assert_array_equal(outcome.residuals, expected, strict=True)
            np.testing.assert_array_equal(bare.residuals, expected, strict=True)
            assert bare.trajectory is None

    @pytest.mark.parametrize("stiffness", [1e200, 1e300, 1e308, -1e5, -1e7])
    def test_huge_values_are_an_outcome(self, solver, stiffness):
        (outcome,) = ask(evaluator(solver), [(0, np.array([1.0, stiffness]))])
        assert outcome.status in (Status.SOLVER_FAILURE, Status.NOT_FINITE)
        assert outcome.message

    def test_the_steps_of_a_solver_are_counted_for_each_point(self, solver):
        """By itself or among others, and not those of a simulation that failed before."""
        together = ask(evaluator(solver), [(0, POINTS[i]) for i in (0, 1, 6)])
        alone = [ask(evaluator(solver), [(0, POINTS[i])])[0] for i in (0, 6)]
        assert [together[0].steps, together[2].steps] == [each.steps for each in alone]
        assert all(each.steps > 0 for each in alone)
        assert together[1].ok or together[1].steps == 0


def with_sigmas(sigma, relative=0.0):
    """The output of the first experiment with other sigmas, and the outcome of a point."""
    (output,) = EXPERIMENTS[0].outputs
    output = replace(output, sigma=sigma, relative_sigma=relative)
    experiment = replace(EXPERIMENTS[0], outputs=(output,))
    (outcome,) = ask(fresh("dormand_prince", (experiment,)), [(0, POINTS[0])])
    return output, outcome


def test_each_residual_is_divided_by_its_own_sigma():
    output, outcome = with_sigmas(0.02, 0.3)
    (plain,) = ask(evaluator("dormand_prince"), [(0, POINTS[0])])
    sigma = np.sqrt(0.02**2 + (0.3 * output.values) ** 2)
    expected = plain.residuals * EXPERIMENTS[0].outputs[0].sigma / sigma
    np.testing.assert_allclose(outcome.residuals, expected, rtol=1e-13)


@pytest.mark.parametrize("sigma", [1e-309, 1e-150])
def test_residuals_that_overflow_are_an_outcome(sigma):
    """Or their squares would."""
    _, outcome = with_sigmas(sigma)
    assert outcome.status is Status.NOT_FINITE
    assert "so large that" in outcome.message


def test_equal_steps_are_as_many_as_fit():
    (outcome,) = ask(evaluator("rk4"), [(0, POINTS[0])])
    run = EXPERIMENTS[0]
    ends = [run.start, run.stop]
    times = np.unique(np.concatenate([ends, run.outputs[0].times, *(i.times for i in run.inputs)]))
    gaps = np.diff(times[(times >= run.start) & (times <= run.stop)])
    assert outcome.steps == sum(int(np.ceil(gap / 0.02 - 1e-9)) for gap in gaps)


@pytest.mark.parametrize("solver", ["dormand_prince", "cvode"])
def test_a_stiffer_spring_takes_more_steps(solver):
    soft, stiff = ask(evaluator(solver), [(0, np.array([1.0, 25.0])), (0, np.array([1.0, 1e6]))])
    assert stiff.steps > 5 * soft.steps


PULL = Effect("pull", "der(v)", equation="-k*x", coefficients=(("k", 0.0),))


@pytest.mark.parametrize("effects", [(), (PULL,)])
@pytest.mark.parametrize("solver", ["dormand_prince", "cvode"])
def test_a_step_limit_ends_a_simulation_that_needs_more_steps(solver, effects):
    points = [np.array([1.0, k, *(9.0 for _ in effects)]) for k in (25.0, 1e6)]

    def answers(*limits):
        tasks = [Task(i, 0, points[p], "residuals", effects, step_limit=n) for i, (p, n) in limits]
        return evaluator(solver).evaluate(TaskBatch.of(tasks))

    soft, stiff = answers(*enumerate([(0, 0), (1, 0)]))
    most = soft.steps
    kept, ended, free, less = answers(*enumerate([(0, most), (1, most), (1, 0), (0, most - 1)]))
    assert (bits(kept), bits(free)) == (bits(soft), bits(stiff))
    assert (kept.steps, free.steps) == (most, stiff.steps)
    for outcome, limit in ((ended, most), (less, most - 1)):
        assert outcome.status is Status.SOLVER_FAILURE
        said = rf"the simulation reached its limit of {limit} steps at t = \S+ s$"
        assert re.fullmatch(said, outcome.message)


@pytest.mark.parametrize("solver", ["rk4", "fmu"])
def test_given_steps_have_no_limit_of_their_number(solver):
    tasks = [Task(0, 0, POINTS[0]), Task(1, 0, POINTS[0], step_limit=1)]
    plain, limited = evaluator(solver).evaluate(TaskBatch.of(tasks))
    assert bits(limited) == bits(plain)


@pytest.mark.parametrize("solver", ["dormand_prince", "cvode"])
def test_a_tolerance_that_vanishes_is_no_division_by_zero(solver):
    (outcome,) = ask(fresh(solver, rtol=1e-6, atol=5e-324, max_steps=2000), [(0, POINTS[0])])
    assert outcome.ok or outcome.message


@pytest.mark.parametrize(
    ("rtol", "reason"), [(1e-30, "model.max_steps"), (1e-300, "did not meet the tolerance")]
)
def test_tolerance_out_of_reach_is_an_outcome(rtol, reason):
    asked = fresh("dormand_prince", rtol=rtol, max_steps=10_000)
    for outcome in ask(asked, [(0, POINTS[0]), (1, POINTS[2])]):
        assert outcome.status is Status.SOLVER_FAILURE
        assert re.search(f"{reason}.* at t = ", outcome.message)


@pytest.mark.parametrize("solver", list(SOLVERS))
@pytest.mark.parametrize(
    ("name", "when", "why"),
    [
        ("fails_late", "continue at t = 1", "the FMU said: rate {} is too much after a second"),
        ("talks", "be initialised at t = 0 s", "the FMU said: rate {} is too much"),
    ],
)
def test_a_failure_tells_when_and_why_and_nothing_of_its_neighbours(
    solver, name, when, why, built_fmu
):
    """An FMU that fails on its way, and one that talks at each rate below 0 and fails at others."""
    times = np.linspace(0.0, 3.0, 13)
    inputs = (Input("u", times, np.sin(times)),)
    experiment = Experiment("e", 0.0, 3.0, inputs, (Output("y", times, np.zeros(13)),))
    model = Model("decay.fmu", built_fmu(name), *SOLVERS[solver], ("rate",))
    asked = Evaluator(model, [experiment], "test")
    rates = [1.0, 2.5, 0.5, -0.5, 3.0, -0.25, 4.0, 1.5]
    outcomes = ask(asked, [(0, np.array([rate])) for rate in rates])
    assert [o.ok for o in outcomes] == [rate <= 2.0 for rate in rates]
    for rate, outcome in zip(rates, outcomes, strict=True):
        assert bits(outcome) == bits(ask(asked, [(0, np.array([rate]))])[0])
        if not outcome.ok:
            assert outcome.status is Status.SOLVER_FAILURE
            said = re.escape(why.format(f"{rate:g}"))
            assert re.match(f"the FMU could not {when}[^;]*; {said}$", outcome.message)
    asked.close()
