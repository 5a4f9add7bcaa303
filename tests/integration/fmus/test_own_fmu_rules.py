"""The test FMUs refuse what the standard forbids, so that a caller who breaks a rule is found."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmus.drive import Driven

Give = Callable[[str, int], Path]
Open = Callable[..., Driven]

pytestmark = pytest.mark.usefixtures("fmpy_prints")

BOTH = pytest.mark.parametrize("fmi", [2, 3])


@pytest.fixture
def opened(own_fmu: Give, tmp_path: Path) -> Iterator[Open]:
    """Instances of test models, which are freed when the test is over."""
    instances: list[Driven] = []

    def give(name: str, fmi: int, kind: str = "ModelExchange") -> Driven:
        instances.append(Driven(own_fmu(name, fmi), kind, tmp_path))
        return instances[-1]

    yield give
    for instance in instances:
        instance.close()


def at_ease(opened: Open, name: str, fmi: int) -> Driven:
    """An instance in continuous time."""
    driven = opened(name, fmi)
    driven.initialize()
    driven.settle()
    return driven


class Refusal:
    """What was called failed, and the model said why."""

    def __init__(self, capsys: pytest.CaptureFixture[str], message: str) -> None:
        self.capsys, self.message = capsys, message

    def __enter__(self) -> None:
        self.failure = pytest.raises(FMICallException)
        self.failure.__enter__()

    def __exit__(self, *what: object) -> bool:
        passed = bool(self.failure.__exit__(*what))  # type: ignore[arg-type]
        assert self.message in self.capsys.readouterr().out
        return passed


@BOTH
def test_a_fixed_parameter_in_continuous_time(
    opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = at_ease(opened, "bouncing_ball", fmi)

    with Refusal(capsys, "g cannot be set while the model is in continuous-time mode"):
        driven.set("g", 1.0)


@BOTH
def test_discrete_inputs_belong_to_event_mode(
    opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = at_ease(opened, "held_input", fmi)

    for name, value in {"u": 1.0, "enabled": False, "gain": 2.0}.items():
        with Refusal(capsys, f"{name} cannot be set while the model is in continuous-time mode"):
            driven.set(name, value)

    driven.fmu.enterEventMode()
    driven.set("u", 2.0)
    with Refusal(capsys, "the event iteration is not finished"):
        driven.fmu.enterContinuousTimeMode()
    driven.settle()
    assert driven.vector("getDerivatives", 1) == [2.0]


@BOTH
def test_outputs_cannot_be_set(opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]) -> None:
    with Refusal(capsys, "y cannot be set while the model is instantiated"):
        opened("dahlquist", fmi).set("y", 1.0)


@BOTH
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_no_number(
    opened: Open, fmi: int, value: float, capsys: pytest.CaptureFixture[str]
) -> None:
    with Refusal(capsys, "not a possible value of k"):
        opened("dahlquist", fmi).set("k", value)


@BOTH
def test_what_is_not_there_before_initialization(
    opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = opened("bouncing_ball", fmi)

    with Refusal(capsys, "not allowed while the model is instantiated"):
        driven.vector("getEventIndicators", 1)
    with Refusal(capsys, "not allowed while the model is instantiated"):
        driven.get("height")
    with Refusal(capsys, "not allowed while the model is instantiated"):
        driven.fmu.setTime(1.0)


@BOTH
def test_states_are_set_in_continuous_time_alone(
    opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = at_ease(opened, "dahlquist", fmi)

    driven.set_states([2.0])
    with Refusal(capsys, "state 0 is not finite"):
        driven.set_states([np.nan])
    driven.fmu.enterEventMode()
    with Refusal(capsys, "not allowed while the model is in event mode"):
        driven.set_states([2.0])


@BOTH
def test_steps_past_a_time_event_and_before_the_last_one(
    opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = opened("stair", fmi)
    driven.initialize()
    assert driven.settle()[4:] == (True, 1.0)

    driven.fmu.setTime(1.5)
    with Refusal(capsys, "time 1.5 is past the time event at 1"):
        driven.fmu.completedIntegratorStep()
    driven.fmu.setTime(1.0)
    driven.fmu.completedIntegratorStep()
    driven.fmu.enterEventMode()
    driven.settle()
    with Refusal(capsys, "time 0.5 is before the last event at 1"):
        driven.fmu.setTime(0.5)


@BOTH
def test_steps_past_the_stop_time(
    opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = opened("dahlquist", fmi, "CoSimulation")
    driven.initialize(stop=1.0)

    driven.fmu.doStep(0.0, 0.5)
    with Refusal(capsys, "the step begins at 0.6, the model is at 0.5"):
        driven.fmu.doStep(0.6, 0.1)
    with Refusal(capsys, "the step size must be positive, is 0"):
        driven.fmu.doStep(0.5, 0.0)
    with Refusal(capsys, "the step ends after the stop time 1"):
        driven.fmu.doStep(0.5, 0.6)
    driven.fmu.doStep(0.5, 0.5)


@BOTH
def test_a_model_that_has_ended_goes_no_further(
    opened: Open, fmi: int, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = opened("stair", fmi)
    driven.set("counter", 9)
    driven.initialize()
    driven.settle()
    driven.fmu.setTime(1.0)
    driven.fmu.enterEventMode()

    assert driven.update()[1]
    with Refusal(capsys, "the model has asked for the end of the simulation"):
        driven.fmu.enterContinuousTimeMode()
    driven.fmu.terminate()


def test_an_experiment_is_set_up_first(opened: Open, capsys: pytest.CaptureFixture[str]) -> None:
    with Refusal(capsys, "the experiment has not been set up"):
        opened("dahlquist", 2).fmu.enterInitializationMode()


def test_structural_parameters_belong_to_configuration_mode(
    opened: Open, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = opened("types", 3)

    with Refusal(capsys, "n cannot be set while the model is instantiated"):
        driven.set("n", 3)
    driven.fmu.enterConfigurationMode()
    driven.set("n", 3)
    driven.fmu.exitConfigurationMode()
    with Refusal(capsys, "3 values expected, got 2"):
        driven.set("rates", [1.0, 2.0])
    driven.set("rates", [1.0, 2.0, 3.0])
    driven.set("z", [1.0, 1.0, 2.0])
    driven.initialize()
    driven.settle()
    assert driven.fmu.getNumberOfContinuousStates() == 4
    assert driven.vector("getDerivatives", 4)[1:].tolist() == [-1.0, -2.0, -6.0]


@BOTH
@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_a_reset_instance_is_as_good_as_new(opened: Open, fmi: int, kind: str) -> None:
    driven = opened("bouncing_ball", fmi, kind)
    driven.set("g", 3.0)
    driven.initialize(1.0)
    driven.fmu.terminate()
    driven.fmu.reset()
    driven.initialize()

    assert driven.get("g") == 9.81
    assert driven.get("time") == 0.0
    assert driven.get("height") == 1.0


@BOTH
def test_a_saved_state_is_the_whole_simulation(opened: Open, fmi: int) -> None:
    driven = opened("bouncing_ball", fmi, "CoSimulation")
    driven.initialize()
    driven.fmu.doStep(0.0, 0.4)
    fmu = driven.fmu
    save, restore = (
        (fmu.getFMUstate, fmu.setFMUstate) if driven.old else (fmu.getFMUState, fmu.setFMUState)
    )
    saved = save()

    driven.fmu.doStep(0.4, 0.4)
    first = [driven.get(name) for name in ("time", "height", "velocity", "bounces")]
    restore(saved)
    assert driven.get("bounces") == 0
    driven.fmu.doStep(0.4, 0.4)
    assert [driven.get(name) for name in ("time", "height", "velocity", "bounces")] == first
    (fmu.freeFMUstate if driven.old else fmu.freeFMUState)(saved)


@BOTH
@pytest.mark.parametrize(
    ("name", "states", "knowns"),
    [
        ("van_der_pol", [1.3, -0.4], ["x0", "x1", "mu", "u"]),
        ("robertson", [0.9, 2e-5, 0.1], ["A", "B", "C", "k1", "k2", "k3"]),
    ],
)
def test_directional_derivatives_are_the_differences(
    opened: Open, fmi: int, name: str, states: list[float], knowns: list[str]
) -> None:
    def rates(known: str, factor: float) -> np.ndarray:
        driven = opened(name, fmi)
        places = [v.name for v in driven.description.modelVariables]
        x = [value * factor if n == known else value for n, value in start.items()]
        if known not in start:
            value = factor if known == "u" else factor * float(driven.variables[known].start)
            driven.set(known, value)
        assert set(start) < set(places)
        driven.initialize()
        driven.settle()
        driven.set_states(x)
        return driven.vector("getDerivatives", len(x))

    driven = at_ease(opened, name, fmi)
    names = [v.derivative.name for v in driven.variables.values() if v.derivative]
    unknowns = [v.valueReference for v in driven.variables.values() if v.derivative]
    start = dict(zip(names, states, strict=True))
    driven.set_states(states)
    for known in knowns:
        given = driven.fmu.getDirectionalDerivative(unknowns, [driven.reference(known)], [1.0])
        size = start.get(known) or (1.0 if known == "u" else float(driven.variables[known].start))
        expected = (rates(known, 1.0 + 1e-5) - rates(known, 1.0 - 1e-5)) / (2e-5 * size)
        assert np.allclose(given, expected, rtol=1e-5, atol=1e-9)


@BOTH
def test_nominals_change_with_an_event(opened: Open, fmi: int) -> None:
    driven = at_ease(opened, "nominals", fmi)
    assert driven.vector("getNominalsOfContinuousStates", 1) == [1.0]

    driven.set_states([10.5])
    driven.fmu.enterEventMode()

    assert driven.settle()[2]
    assert driven.vector("getNominalsOfContinuousStates", 1) == [10.0]


@BOTH
def test_a_step_event_is_reported_with_the_completed_step(opened: Open, fmi: int) -> None:
    driven = at_ease(opened, "step_events", fmi)

    assert driven.fmu.completedIntegratorStep() == (False, False)
    driven.set_states([1.25])
    assert driven.fmu.completedIntegratorStep() == (True, False)
    driven.fmu.enterEventMode()
    assert driven.settle()[3]
    assert driven.vector("getContinuousStates", 1) == [0.25]


@BOTH
def test_the_number_of_rounds_of_an_event_iteration(opened: Open, fmi: int) -> None:
    driven = at_ease(opened, "iterates", fmi)
    driven.fmu.setTime(1.0)
    driven.fmu.enterEventMode()

    assert [driven.update()[0] for _ in range(5)] == [True, True, True, True, False]


@BOTH
def test_a_relay_that_chatters_passes_no_time(opened: Open, fmi: int) -> None:
    driven = at_ease(opened, "chatters", fmi)
    slopes = []
    for x in (-1e-12, 1e-12, -1e-12):
        driven.set_states([x])
        driven.fmu.enterEventMode()
        driven.settle()
        slopes.append(driven.vector("getDerivatives", 1)[0])

    assert slopes == [1.0, -1.0, 1.0]
