"""Every task has one outcome, whatever happens, and no outcome depends on its neighbours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fmpy.fmi2 import FMU2Model
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st
from support.truth.example_models import MODELS, REFERENCES, sampled_experiment

from workers import evaluate
from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import (
    Experiment,
    FloatArray,
    Input,
    Interface,
    Model,
    Outcome,
    Output,
    Solver,
    Status,
    Task,
    Want,
)
from workers.wire import TaskBatch

SOLVERS: dict[str, tuple[Interface, Solver]] = {
    "dormand_prince": ("model_exchange", Solver("dormand_prince")),
    "rk4": ("model_exchange", Solver("rk4", 0.02)),
    "cvode": ("model_exchange", Solver("cvode")),
    "fmu": ("co_simulation", Solver("fmu")),
}
EXPERIMENTS = tuple(
    sampled_experiment(REFERENCES["mass_spring_damper"], interpolation, seed)  # type: ignore[arg-type]
    for seed, interpolation in enumerate(["linear", "hold", "linear"])
)
POINTS = np.array(
    [[1.0, 25.0], [-1.0, 25.0], [1.5, 30.0], [np.nan, 1.0], [0.0, 9.0], [2.0, np.inf], [0.7, 80.0]]
)


@cache
def evaluator(solver: str) -> Evaluator:
    return fresh(*SOLVERS[solver])


def fresh(interface: Interface, solver: Solver) -> Evaluator:
    archive = (MODELS / "mass_spring_damper.fmu").read_bytes()
    model = Model("mass.fmu", archive, interface, solver, ("m", "k"))
    return Evaluator(model, EXPERIMENTS, "test")


def ask(to: Evaluator, tasks: list[tuple[int, FloatArray]], want: Want = "residuals") -> list:
    """Outcomes of (experiment, values), with ids that are not places."""
    packed = [Task(100 + 7 * i, e, values, want) for i, (e, values) in enumerate(tasks)]
    outcomes = to.evaluate(TaskBatch.of(packed))
    assert [o.task for o in outcomes] == [task.id for task in packed]
    return outcomes


def bits(outcome: Outcome) -> tuple[Status, str, bytes, bytes]:
    """All of an outcome but what may differ: its id, its seconds and its worker."""
    residuals, trajectory = outcome.residuals, outcome.trajectory
    return (
        outcome.status,
        outcome.message,
        b"" if residuals is None else residuals.tobytes(),
        b"" if trajectory is None else trajectory.times.tobytes() + trajectory.values.tobytes(),
    )


@cache
def alone(solver: str, experiment: int, point: int) -> tuple[Status, str, bytes, bytes]:
    return bits(ask(evaluator(solver), [(experiment, POINTS[point])])[0])


@pytest.mark.parametrize("solver", list(SOLVERS))
class TestEverySolver:
    @limits(max_examples=25)
    @given(
        st.lists(
            st.tuples(st.integers(0, len(EXPERIMENTS) - 1), st.integers(0, len(POINTS) - 1)),
            min_size=1,
            max_size=25,
        )
    )
    def test_answers_do_not_depend_on_the_batch_or_its_order(
        self, solver: str, chosen: list[tuple[int, int]]
    ) -> None:
        outcomes = ask(evaluator(solver), [(e, POINTS[p]) for e, p in chosen])
        assert [bits(o) for o in outcomes] == [alone(solver, e, p) for e, p in chosen]

    def test_memory_limit_cuts_a_batch_without_a_trace(
        self, solver: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        tasks = [(e, point) for point in POINTS for e in range(len(EXPERIMENTS))]
        whole = ask(evaluator(solver), tasks, "trajectory")
        monkeypatch.setattr(evaluate, "MAX_VALUES", 250)
        parts = ask(evaluator(solver), tasks, "trajectory")
        assert [bits(o) for o in parts] == [bits(o) for o in whole]

    def test_failures_leave_the_rest_of_their_batch_alone(self, solver: str) -> None:
        outcomes = ask(evaluator(solver), [(0, point) for point in POINTS])
        assert [o.ok for o in outcomes] == [True, False, True, False, False, False, True]
        for outcome in outcomes:
            assert (outcome.residuals is None) == (not outcome.ok) == bool(outcome.message)
            assert outcome.trajectory is None
            assert outcome.worker == "test"

    def test_fresh_evaluator_gives_the_same_bits(self, solver: str) -> None:
        new = fresh(*SOLVERS[solver])
        tasks = [(e, point) for e in range(len(EXPERIMENTS)) for point in POINTS]
        answers = [bits(o) for o in ask(new, tasks, "trajectory")]
        assert answers == [bits(o) for o in ask(new, tasks, "trajectory")]
        assert answers == [bits(o) for o in ask(evaluator(solver), tasks, "trajectory")]
        new.close()
        new.close()

    def test_trajectory_and_residuals_tell_the_same(self, solver: str) -> None:
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

    def test_each_residual_is_divided_by_its_own_sigma(self, solver: str) -> None:
        interface, chosen = SOLVERS[solver]
        (output,) = EXPERIMENTS[0].outputs
        louder = replace(output, sigma=0.02, relative_sigma=0.3)
        archive = (MODELS / "mass_spring_damper.fmu").read_bytes()
        model = Model("mass.fmu", archive, interface, chosen, ("m", "k"))
        growing = Evaluator(model, [replace(EXPERIMENTS[0], outputs=(louder,))], "test")
        (outcome,) = ask(growing, [(0, POINTS[0])])
        (plain,) = ask(evaluator(solver), [(0, POINTS[0])])
        sigma = np.sqrt(0.02**2 + (0.3 * output.values) ** 2)
        expected = plain.residuals * output.sigma / sigma
        np.testing.assert_allclose(outcome.residuals, expected, rtol=1e-13)

    @pytest.mark.parametrize("mass", [-1.0, 0.0, np.nan])
    def test_fmu_says_itself_why_it_refuses_a_value(self, solver: str, mass: float) -> None:
        (outcome,) = ask(evaluator(solver), [(0, np.array([mass, 25.0]))])
        start = EXPERIMENTS[0].start
        assert outcome.status is Status.SOLVER_FAILURE
        assert outcome.message == (
            f"the FMU could not be initialised at t = {start:.9g} s; "
            f"it said: mass must be positive, got {mass:g}"
        )

    @pytest.mark.parametrize("stiffness", [1e200, 1e300, 1e308, -1e5, -1e7])
    def test_huge_values_are_an_outcome(self, solver: str, stiffness: float) -> None:
        (outcome,) = ask(evaluator(solver), [(0, np.array([1.0, stiffness]))])
        assert outcome.status in (Status.SOLVER_FAILURE, Status.NOT_FINITE)
        assert outcome.message

    @pytest.mark.parametrize("sigma", [1e-309, 1e-150])
    def test_residuals_that_overflow_are_an_outcome(self, solver: str, sigma: float) -> None:
        """Or their squares would."""
        interface, chosen = SOLVERS[solver]
        (output,) = EXPERIMENTS[0].outputs
        narrow = replace(EXPERIMENTS[0], outputs=(replace(output, sigma=sigma),))
        archive = (MODELS / "mass_spring_damper.fmu").read_bytes()
        model = Model("mass.fmu", archive, interface, chosen, ("m", "k"))
        (outcome,) = ask(Evaluator(model, [narrow], "test"), [(0, POINTS[0])])
        assert outcome.status is Status.NOT_FINITE
        assert "too large" in outcome.message

    def test_limit_of_steps_is_an_outcome(self, solver: str) -> None:
        interface, chosen = SOLVERS[solver]
        limited = fresh(interface, replace(chosen, max_steps=20))
        (outcome,) = ask(limited, [(0, POINTS[0])])
        assert outcome.status is Status.SOLVER_FAILURE
        assert outcome.message.startswith("the limit on the number of steps was reached at t = ")

    def test_the_steps_of_a_solver_are_counted_for_each_point(self, solver: str) -> None:
        """By itself or among others, and not those of a simulation that failed before."""
        together = ask(evaluator(solver), [(0, POINTS[i]) for i in (0, 1, 6)])
        alone = [ask(evaluator(solver), [(0, POINTS[i])])[0] for i in (0, 6)]
        assert [together[0].steps, together[2].steps] == [each.steps for each in alone]
        assert all(each.steps > 0 for each in alone)
        assert together[1].ok or together[1].steps == 0


def test_equal_steps_are_as_many_as_fit() -> None:
    (outcome,) = ask(evaluator("rk4"), [(0, POINTS[0])])
    run = EXPERIMENTS[0]
    ends = [run.start, run.stop]
    times = np.unique(np.concatenate([ends, run.outputs[0].times, *(i.times for i in run.inputs)]))
    gaps = np.diff(times[(times >= run.start) & (times <= run.stop)])
    assert outcome.steps == sum(int(np.ceil(gap / 0.02 - 1e-9)) for gap in gaps)


@pytest.mark.parametrize("solver", ["dormand_prince", "cvode"])
def test_a_stiffer_spring_takes_more_steps(solver: str) -> None:
    soft, stiff = ask(evaluator(solver), [(0, np.array([1.0, 25.0])), (0, np.array([1.0, 1e6]))])
    assert stiff.steps > 5 * soft.steps


@pytest.mark.parametrize("solver", ["dormand_prince", "cvode"])
def test_a_tolerance_that_vanishes_is_no_division_by_zero(solver):
    chosen = Solver(solver, rtol=1e-6, atol=5e-324, max_steps=2000)
    (outcome,) = ask(fresh("model_exchange", chosen), [(0, POINTS[0])])
    assert outcome.ok or outcome.message


def test_an_instance_that_talks_is_made_to_log_and_shows_it(built_fmu, monkeypatch, capfd):
    asked = []
    instantiate = FMU2Model.instantiate

    def seen(fmu, *arguments, **options):
        asked.append(options["loggingOn"])
        return instantiate(fmu, *arguments, **options)

    monkeypatch.setattr(FMU2Model, "instantiate", seen)
    times = np.linspace(0.0, 2.0, 5)
    run = Experiment("a", 0.0, 2.0, (), (Output("y", times, np.zeros(5)),))
    quiet = Model("talks.fmu", built_fmu("talks"), "model_exchange", Solver("rk4", 0.1), ("rate",))
    for model in (quiet, replace(quiet, logging_on=True)):
        asking = Evaluator(model, [run], "w")
        (outcome,) = ask(asking, [(0, np.array([3.0]))])
        assert "it said: rate 3 is too much" in outcome.message
        asking.close()
    assert asked == [False, True]
    assert model.key == quiet.key
    assert set(capfd.readouterr().err.splitlines()) == {"error: rate 3 is too much"}


@pytest.mark.parametrize(
    ("rtol", "reason"),
    [
        (1e-30, "the limit on the number of steps was reached"),
        (1e-300, "no step was short enough for the tolerance"),
    ],
)
def test_tolerance_out_of_reach_is_an_outcome(rtol: float, reason: str) -> None:
    solver = Solver("dormand_prince", rtol=rtol, max_steps=10_000)
    outcomes = ask(fresh("model_exchange", solver), [(0, POINTS[0]), (1, POINTS[2])])
    for outcome in outcomes:
        assert outcome.status is Status.SOLVER_FAILURE
        assert outcome.message.startswith(f"{reason} at t = ")


def test_unknown_variable_is_refused_when_opened() -> None:
    archive = (MODELS / "mass_spring_damper.fmu").read_bytes()
    model = Model("mass.fmu", archive, *SOLVERS["rk4"], ("stifness",))
    with pytest.raises(ModelError, match="no variable 'stifness'"):
        Evaluator(model, EXPERIMENTS, "test")


def decay(archive: bytes, solver: str, stop: float = 3.0) -> Evaluator:
    """One of the test models, with `rate` to be set."""
    times = np.linspace(0.0, stop, 13)
    inputs = (Input("u", times, np.sin(times)),)
    experiment = Experiment("e", 0.0, stop, inputs, (Output("y", times, np.zeros(13)),))
    model = Model("decay.fmu", archive, *SOLVERS[solver], ("rate",))
    return Evaluator(model, [experiment], "test")


@pytest.mark.parametrize("solver", list(SOLVERS))
class TestModelsThatMisbehave:
    def test_failure_on_the_way_names_its_time_and_spares_its_neighbours(
        self, solver: str, built_fmu: Callable[[str], bytes]
    ) -> None:
        late = decay(built_fmu("fails_late"), solver)
        rates = [1.0, 2.5, 0.5, 3.0, 4.0, 2.0]
        outcomes = ask(late, [(0, np.array([rate])) for rate in rates])
        assert [o.ok for o in outcomes] == [True, False, True, False, False, True]
        for rate, outcome in zip(rates, outcomes, strict=True):
            assert bits(outcome) == bits(ask(late, [(0, np.array([rate]))])[0])
            if not outcome.ok:
                assert outcome.status is Status.SOLVER_FAILURE
                assert outcome.message.startswith("the FMU could not go on at t = 1")
                assert outcome.message.endswith(
                    f"it said: rate {rate:g} is too much after a second"
                )

    def test_message_of_a_failure_holds_nothing_that_its_neighbours_said(
        self, solver: str, built_fmu: Callable[[str], bytes]
    ) -> None:
        talking = decay(built_fmu("talks"), solver)
        outcomes = ask(talking, [(0, np.array([rate])) for rate in (1.0, -0.5, 2.5, -0.25, 3.0)])
        assert [o.ok for o in outcomes] == [True, True, False, True, False]
        assert [o.message for o in outcomes if not o.ok] == [
            f"the FMU could not be initialised at t = 0 s; it said: rate {rate} is too much"
            for rate in (2.5, 3)
        ]
