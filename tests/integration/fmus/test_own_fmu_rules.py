"""The test FMUs refuse what the standard forbids, so that a caller who breaks a rule is found."""

from collections.abc import Callable

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmus.drive import Driven

Open = Callable[..., Driven]

pytestmark = pytest.mark.usefixtures("fmpy_prints")


@pytest.fixture(params=[2, 3])
def fmi(request):
    return request.param


@pytest.fixture
def opened(own_fmu, tmp_path):
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


@pytest.fixture
def refused(capsys):
    """What is called must fail, and the model must say why."""

    def expect(message: str, call: Callable[..., object], *given: object) -> None:
        with pytest.raises(FMICallException):
            call(*given)
        assert message in capsys.readouterr().out

    return expect


def test_what_is_not_there_before_initialization(opened, refused, fmi):
    driven = opened("bouncing_ball", fmi)
    refused("not allowed while the model is instantiated", driven.vector, "getEventIndicators", 1)
    refused("not allowed while the model is instantiated", driven.get, "height")
    refused("not allowed while the model is instantiated", driven.fmu.setTime, 1.0)
    refused("height cannot be set while the model is instantiated", driven.set, "height", 1.0)
    refused("not a possible value of g", driven.set, "g", np.nan)
    refused("not a possible value of g", driven.set, "g", np.inf)
    if fmi == 2:
        refused("the experiment has not been set up", driven.fmu.enterInitializationMode)


def test_discrete_inputs_and_parameters_belong_to_event_mode(opened, refused, fmi):
    driven = at_ease(opened, "held_input", fmi)
    for name, value in {"u": 1.0, "enabled": False, "gain": 2.0}.items():
        refused(
            f"{name} cannot be set while the model is in continuous-time mode",
            driven.set,
            name,
            value,
        )
    driven.fmu.enterEventMode()
    driven.set("u", 2.0)
    refused("the event iteration is not finished", driven.fmu.enterContinuousTimeMode)
    driven.settle()
    assert driven.vector("getDerivatives", 1) == [2.0]


def test_states_are_set_in_continuous_time_alone(opened, refused, fmi):
    driven = at_ease(opened, "dahlquist", fmi)
    driven.set_states([2.0])
    refused("state 0 is not finite", driven.set_states, [np.nan])
    driven.fmu.enterEventMode()
    refused("not allowed while the model is in event mode", driven.set_states, [2.0])


def test_steps_past_a_time_event_and_before_the_last_one(opened, refused, fmi):
    driven = opened("stair", fmi)
    driven.initialize()
    assert driven.settle()[4:] == (True, 1.0)
    driven.fmu.setTime(1.5)
    refused("time 1.5 is past the time event at 1", driven.fmu.completedIntegratorStep)
    driven.fmu.setTime(1.0)
    driven.fmu.completedIntegratorStep()
    driven.fmu.enterEventMode()
    driven.settle()
    refused("time 0.5 is before the last event at 1", driven.fmu.setTime, 0.5)


@pytest.mark.parametrize(
    ("name", "point", "step", "message"),
    [
        ("dahlquist", 0.6, 0.1, "the step begins at 0.6, the model is at 0.5"),
        ("dahlquist", 0.5, 0.0, "the step size must be positive, is 0"),
        ("dahlquist", 0.5, 0.6, "the step ends after the stop time 1"),
        ("fixed_step", 0.5, 0.05, "the step size must be 0.1, is 0.05"),
    ],
)
def test_communication_steps(opened, refused, fmi, name, point, step, message):
    driven = opened(name, fmi, "CoSimulation")
    driven.initialize(stop=1.0)
    for n in range(5):
        driven.fmu.doStep(0.1 * n, 0.1)
    refused(message, driven.fmu.doStep, point, step)
    driven.fmu.doStep(0.5, 0.1)


def test_a_model_that_has_ended_goes_no_further(opened, refused, fmi):
    driven = opened("stair", fmi)
    driven.set("counter", 9)
    driven.initialize()
    driven.settle()
    driven.fmu.setTime(1.0)
    driven.fmu.enterEventMode()
    assert driven.update()[1]
    refused("the model has asked for the end of the simulation", driven.fmu.enterContinuousTimeMode)
    driven.fmu.terminate()


def test_structural_parameters_belong_to_configuration_mode(opened, refused):
    driven = opened("types", 3)
    refused("n cannot be set while the model is instantiated", driven.set, "n", 3)
    driven.fmu.enterConfigurationMode()
    driven.set("n", 3)
    driven.fmu.exitConfigurationMode()
    refused("3 values expected, got 2", driven.set, "rates", [1.0, 2.0])
    driven.set("rates", [1.0, 2.0, 3.0])
    driven.set("z", [1.0, 1.0, 2.0])
    driven.initialize()
    driven.settle()
    assert driven.fmu.getNumberOfContinuousStates() == 4
    assert driven.vector("getDerivatives", 4)[1:].tolist() == [-1.0, -2.0, -6.0]


def test_a_saved_state_is_the_whole_simulation(opened, fmi):
    driven = opened("bouncing_ball", fmi, "CoSimulation")
    driven.initialize()
    driven.fmu.doStep(0.0, 0.4)
    names, state = ("time", "height", "velocity", "bounces"), "state" if driven.old else "State"
    saved = getattr(driven.fmu, f"getFMU{state}")()
    driven.fmu.doStep(0.4, 0.4)
    first = [driven.get(name) for name in names]
    getattr(driven.fmu, f"setFMU{state}")(saved)
    assert driven.get("bounces") == 0
    driven.fmu.doStep(0.4, 0.4)
    assert [driven.get(name) for name in names] == first
    getattr(driven.fmu, f"freeFMU{state}")(saved)


def test_nominals_change_with_an_event(opened, fmi):
    driven = at_ease(opened, "nominals", fmi)
    assert driven.vector("getNominalsOfContinuousStates", 1) == [1.0]
    driven.set_states([10.5])
    driven.fmu.enterEventMode()
    assert driven.settle()[2]
    assert driven.vector("getNominalsOfContinuousStates", 1) == [10.0]


@pytest.mark.parametrize("name", ["once_per_process", "once_undeclared"])
def test_a_second_instance_is_refused_whether_or_not_that_is_declared(opened, capsys, fmi, name):
    declared = opened(name, fmi).description.modelExchange.canBeInstantiatedOnlyOncePerProcess
    assert declared == (name == "once_per_process")
    with pytest.raises(Exception, match="Failed to instantiate"):
        opened(name, fmi)
    assert "can be instantiated only once in a process" in capsys.readouterr().out
