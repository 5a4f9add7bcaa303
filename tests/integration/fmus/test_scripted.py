"""What the loops do with answers that FMUs seldom give: calls that fail, events at odd moments.

The FMU is a decay from 1 at a rate of 1 in which happens what its parameters say.
"""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support.problems.driven_spring import model_of
from support.simulated import answers
from support.thinning import thinned

from workers.messages import Experiment, Outcome, Output, Solver, Status, Task

Simulate = Callable[..., list[Outcome]]

DISCARD, ERROR, FATAL = 2, 3, 4
TIMES = np.linspace(0.0, 2.0, 5)
DECAY = np.exp(-TIMES)
SOLVERS = {
    "dormand_prince": Solver("dormand_prince", rtol=1e-8, atol=1e-8, max_steps=3000),
    "rk4": Solver("rk4", 0.05, max_steps=3000),
    "cvode": Solver("cvode", rtol=1e-8, atol=1e-8, max_steps=3000),
    "fmu": Solver("fmu", max_steps=3000),
}
EXCHANGE = ["dormand_prince", "rk4", "cvode"]
INITIAL = ["Reset", "SetupExperiment", "EnterInitializationMode", "ExitInitializationMode"]
ADVANCING = [
    *("SetTime", "GetContinuousStates", "SetContinuousStates", "EnterContinuousTimeMode"),
    *("CompletedIntegratorStep", "NewDiscreteStates", "GetDerivatives"),
]
PLACES = ["", *INITIAL, *ADVANCING[:5], "DoStep", "GetDirectionalDerivative", "GetReal"]
PLACES += ADVANCING[5:]
"""Those of `tests/fmus/models/scripted/model.c`, with the names of FMI 2."""
OUTPUTS = ("y", "events", "jumped")
SCRIPT = (
    *("function", "nth", "status", "at", "after", "level", "endless", "ends", "stops"),
    *("since", "bad"),
)


@pytest.fixture
def simulate(own_fmu):
    """Simulate what several scripts say, one after the other."""

    def run(fmi, solver, *scripts, logging_on=False):
        fmu = own_fmu("scripted", fmi)
        usual = {"nth": 1.0, "at": -1.0, "level": -1.0, "function": "", "status": 0.0, "bad": 0.0}
        usual |= dict.fromkeys(("after", "endless", "ends", "stops", "since"), 1e9)
        points = [usual | script for script in scripts]
        points = [point | {"function": PLACES.index(point["function"])} for point in points]
        model = replace(model_of(SOLVERS[solver], SCRIPT, fmu), logging_on=logging_on)
        outputs = tuple(Output(name, TIMES, 0.0 * TIMES) for name in OUTPUTS)
        tasks = [
            Task(i, 0, np.array([float(point[name]) for name in SCRIPT]), "trajectory")
            for i, point in enumerate(points)
        ]
        return answers(model, [Experiment("e", 0.0, 2.0, (), outputs)], tasks)

    return run


def values(outcome: Outcome) -> np.ndarray:
    """(times, outputs) of a simulation that must have reached its end."""
    assert outcome.ok, outcome.message
    return outcome.trajectory.values


def ended_at(outcome: Outcome, why: str) -> float:
    """When a simulation failed for the reason that is expected."""
    assert outcome.status is Status.SOLVER_FAILURE
    assert why in outcome.message
    return float(re.search(r"at t = (\S+) s", outcome.message)[1])


HOW = (lambda solver, *_: solver, lambda _, function, how, fmi: (function, fmi), lambda *a: a[2])


NEVER = {("SetupExperiment", 3)}
"""There is none in FMI 3."""
FAILING = [
    (solver, function, status, fmi)
    for solver in SOLVERS
    for function in [*INITIAL, "GetReal"]
    for status in (DISCARD, ERROR, FATAL)
    for fmi in (2, 3)
    if (function, fmi) not in NEVER
]


@pytest.mark.parametrize(("solver", "function", "status", "fmi"), thinned(FAILING, *HOW))
def test_a_failing_call_ends_the_simulation(simulate, solver, function, status, fmi):
    """In the second simulation: most of these calls come before the script is known at first."""
    # in model exchange the first value that is got stands for the event indicators
    nth = 2 if function == "GetReal" and solver != "fmu" else 1
    script = {"function": function, "status": status, "nth": nth}
    outcome = simulate(fmi, solver, script, script)[0 if function == "GetReal" else 1]
    why = "compute its outputs" if function == "GetReal" else "be initialised"
    assert ended_at(outcome, f"the FMU could not {why}") == 0.0
    assert outcome.residuals is None


CALLED = [(solver, name) for solver in SOLVERS for name in [*INITIAL, "GetReal"]]
CALLED += [(solver, name) for solver in EXCHANGE for name in ADVANCING]


@pytest.mark.parametrize(
    ("solver", "function", "nth", "fmi"),
    thinned(
        [(*called, nth, fmi)
         for nth in (1, 2, 9) for fmi in (2, 3)
         for called in [*CALLED, ("fmu", "DoStep")] if (called[1], fmi) not in NEVER],
        *HOW, lambda solver, function, *_: (solver == "fmu", function),
    ),
)  # fmt: skip
def test_nothing_is_called_after_a_fatal_error(simulate, capfd, solver, function, nth, fmi):
    """The next simulation is one of a new instance; the FMU complains where it is not."""
    fatal = {"function": function, "nth": nth, "status": FATAL}
    outcomes = simulate(fmi, solver, fatal, fatal, {})
    np.testing.assert_allclose(values(outcomes[-1])[:, 0], DECAY, rtol=1e-6)
    if nth == 1:
        assert not outcomes[1].ok
    assert "after a fatal error" not in capfd.readouterr().err


@pytest.mark.parametrize(("solver", "fmi"), [*zip(EXCHANGE, (3, 2, 2), strict=True)])
class TestEvents:
    def test_an_end_by_the_fmu_is_reported(self, simulate, solver, fmi):
        at_once, later = simulate(fmi, solver, {"ends": 0.0}, {"stops": 1.0})
        assert ended_at(at_once, "ended the simulation by itself") == 0.0
        assert 1.0 < ended_at(later, "ended the simulation by itself") <= 1.5

    def test_an_event_after_a_step_is_handled_once(self, simulate, solver, fmi):
        """The FMU asks for an event after the first step behind 0.7 s; x is 5 then."""
        y, events, jumped = values(simulate(fmi, solver, {"after": 0.7})[0]).T
        at = jumped[-1]
        assert 0.7 < at <= 1.0
        assert events[-1] == 1.0
        expected = np.where(at <= TIMES, 5.0 * np.exp(at - TIMES), DECAY)
        np.testing.assert_allclose(y, expected, rtol=1e-6)

    def test_a_time_event_comes_in_time(self, simulate, solver, fmi):
        """x is 5 from the event on, also where it is at a time of the grid, but for rounding."""
        moments = [0.3, 0.5, 1.0000000000000002, 0.9999999999999999, 0.0, 2.0]
        scripts = [{"at": at} for at in moments]
        for at, outcome in zip(moments, simulate(fmi, solver, *scripts), strict=True):
            y, events, jumped = values(outcome).T
            assert (events[-1], jumped[-1]) == (1.0, at)
            late = at - 1e-12 < TIMES
            if at == 0.0:
                late = TIMES > 0.0
            expected = np.where(late, 5.0 * np.exp(at - TIMES), DECAY)
            np.testing.assert_allclose(y, expected, rtol=1e-6)

    def test_a_state_event_is_located(self, simulate, solver, fmi):
        """Where x crosses a level it is doubled, again and again."""
        levels = [0.9, 0.5, 0.13533528323661270]
        scripts = [{"level": level} for level in levels]
        for level, outcome in zip(levels, simulate(fmi, solver, *scripts), strict=True):
            y, events, jumped = values(outcome).T
            crossings = np.log(2.0) * np.arange(10) - np.log(level)
            before, after = ((crossings[:, None] < TIMES + s * 1e-6).sum(0) for s in (-1, 1))
            assert (before <= events).all()
            assert (events <= after).all()
            np.testing.assert_allclose(
                jumped[events > 0], crossings[events[events > 0].astype(int) - 1], rtol=1e-6
            )
            np.testing.assert_allclose(y, DECAY * 2.0**events, rtol=1e-6)

    def test_events_without_end_are_a_failure(self, simulate, solver, fmi):
        (outcome,) = simulate(fmi, solver, {"at": 0.4, "endless": 0.4})
        assert ended_at(outcome, "events followed each other without end") == 0.4


ADAPTIVE = pytest.mark.parametrize(("solver", "fmi"), [("dormand_prince", 3), ("cvode", 2)])


@ADAPTIVE
def test_a_discarded_step_is_tried_again_shorter(simulate, solver, fmi):
    discards = {"function": "GetDerivatives", "nth": 4, "status": DISCARD}
    found = values(simulate(fmi, solver, discards)[0])[:, 0]
    np.testing.assert_allclose(found, DECAY, rtol=1e-6)


@ADAPTIVE
@pytest.mark.parametrize("bad", [1, 2, 3], ids=["no number", "infinite", "huge"])
@pytest.mark.parametrize("since", [-1.0, 0.7])
def test_a_derivative_out_of_range_ends_adaptive_solvers(simulate, solver, fmi, bad, since):
    (outcome,) = simulate(fmi, solver, {"since": since, "bad": bad})
    if outcome.ok:
        assert values(outcome)[-1, 0] > 1e299
    elif outcome.status is Status.SOLVER_FAILURE:
        at = ended_at(outcome, "did not meet the tolerance")
        assert at == pytest.approx(max(since, 0.0), abs=1e-6)


@pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("status", "why"), [(DISCARD, "did not meet the tolerance"), (ERROR, "could not continue")]
)
def test_cvode_takes_its_jacobian_from_the_fmu_which_may_refuse_it(simulate, fmi, status, why):
    refused = {"function": "GetDirectionalDerivative", "nth": -1, "status": status}
    plain, outcome = simulate(fmi, "cvode", {}, refused)
    np.testing.assert_allclose(values(plain)[:, 0], DECAY, rtol=1e-6)
    ended_at(outcome, why)


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_instance_that_is_made_to_log_shows_what_it_says(simulate, capfd, fmi):
    (quiet,) = simulate(fmi, "dormand_prince", {"ends": 0.0})
    assert "logging is on" not in quiet.message + capfd.readouterr().err
    (loud,) = simulate(fmi, "dormand_prince", {"ends": 0.0}, logging_on=True)
    assert "the FMU said: logging is on" in loud.message
    assert "error: logging is on" in capfd.readouterr().err
