"""What the scaffold does that all of them share is shown with two of them by default."""

from typing import Any

import fmpy
import numpy as np
import pytest
from build_fmus import build
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE
from fmpy.validation import validate_fmu
from support.exported import NEEDS_CC
from support.fmu_texts import texts_from, texts_in
from support.simulated import answer
from support.thinning import thinned
from support.truth.example_models import MODELS, REFERENCES, Reference, sampled_experiment, solve

from workers.messages import Interface, Model, Solver

EXAMPLES = sorted(REFERENCES)
EVERY = sorted([*MODELS.glob("*.fmu"), *MODELS.parent.glob("league/**/models/*.fmu")])
TWO = ("mass_spring_damper", "dc_motor_belt")
ONE = pytest.mark.parametrize("name", TWO[:1], indirect=True)
INTERFACES: dict[Interface, Solver] = {
    "model_exchange": Solver("dormand_prince", rtol=1e-10),
    "co_simulation": Solver("fmu"),
}


@pytest.fixture(
    params=[n if n in TWO else pytest.param(n, marks=pytest.mark.slow) for n in EXAMPLES]
)
def name(request):
    return str(request.param)


@pytest.fixture
def archive(name):
    return MODELS / f"{name}.fmu"


@pytest.fixture
def reference(name):
    return REFERENCES[name]


def test_every_example_is_tested():
    assert {path.stem for path in MODELS.glob("*.fmu")} == set(REFERENCES)


@pytest.mark.parametrize("path", EVERY, ids=lambda path: f"{path.parent.parent.name}/{path.stem}")
def test_is_valid_for_three_platforms_and_holds_its_sources(path):
    assert validate_fmu(str(path)) == []
    assert set(fmpy.supported_platforms(str(path))) >= {"linux64", "win64", "darwin64"}
    assert texts_in(path) == texts_from(path.with_suffix(""))


@pytest.mark.parametrize(
    ("name", "interface", "interpolation"),
    thinned(
        [(n, i, kind) for n in EXAMPLES for kind in ("linear", "hold") for i in INTERFACES],
        lambda name, *_: name,
        lambda _, *how: how,
    ),
)
def test_agrees_with_the_equations(name, interface, interpolation):
    outputs = simulated(MODELS / f"{name}.fmu", interface, interpolation)
    experiment = sampled_experiment(REFERENCES[name], interpolation)
    times = np.unique(np.concatenate([output.times for output in experiment.outputs]))
    truth = solve(REFERENCES[name], experiment, times)
    for place, output in enumerate(experiment.outputs):
        expected = truth[np.searchsorted(times, output.times), place]
        tolerance = 1e-7 * np.abs(expected).max()
        np.testing.assert_allclose(outputs[place], expected, rtol=0, atol=tolerance)


def simulated(archive, interface, interpolation):
    """The outputs of an example, each at its own times: what is measured is 0."""
    experiment = sampled_experiment(REFERENCES[archive.stem], interpolation)
    model = Model(archive.name, archive.read_bytes(), interface, INTERFACES[interface], ())
    outcome = answer(model, experiment)
    assert outcome.ok, outcome.message
    ends = np.cumsum([len(output.times) for output in experiment.outputs])
    return np.split(-outcome.residuals, ends[:-1])


@NEEDS_CC
def test_rebuilds_to_the_same_bytes_and_simulates_the_same(archive, tmp_path):
    first, second = (build(archive.with_suffix(""), tmp_path / folder) for folder in "ab")
    assert first.read_bytes() == second.read_bytes()
    assert texts_in(first) == texts_in(archive)
    results = [simulated(each, "co_simulation", "hold") for each in (archive, first)]
    for expected, found in zip(*results, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.fixture
def messages():
    return []


@pytest.fixture
def slave(archive, tmp_path, messages):
    """Give an instance for co-simulation, not initialised."""

    def log(*arguments: Any) -> None:
        messages.append(arguments[-1].decode())

    # Not by fmpy.instantiate_fmu, whose loggers all share one, even when it is gone.
    callbacks = fmi2CallbackFunctions()
    callbacks.logger = fmi2CallbackLoggerTYPE(log)
    folder = fmpy.extract(str(archive), str(tmp_path))
    description = fmpy.read_model_description(folder)
    instance = FMU2Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="example",
    )
    instance.instantiate(callbacks=callbacks)
    yield instance
    instance.freeInstance()


def initialise(slave: Any) -> None:
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.exitInitializationMode()


def references(slave: Any) -> dict[str, int]:
    description = fmpy.read_model_description(slave.unzipDirectory)
    return {v.name: v.valueReference for v in description.modelVariables}


def driven(slave: Any, reference: Reference) -> list[float]:
    """All values after a few steps from the reference's start, with inputs that have slopes."""
    known, step = references(slave), reference.seconds / 60.0
    inputs = [known[name] for name in reference.inputs]
    slave.setReal([known[n] for n in reference.starts], list(reference.starts.values()))
    initialise(slave)
    slave.setReal(inputs, [mean for mean, _ in reference.inputs.values()])
    for n in range(5):
        slopes = [amplitude / reference.seconds for _, amplitude in reference.inputs.values()]
        slave.setRealInputDerivatives(inputs, [1] * len(inputs), slopes)
        slave.doStep(n * step, step)
    return list(slave.getReal(list(known.values())))


def test_reset_equals_a_fresh_instance(reference, slave):
    every = list(references(slave).values())
    fresh = slave.getReal(every)
    first = driven(slave, reference)
    slave.reset()
    assert slave.getReal(every) == fresh
    assert driven(slave, reference) == first


def test_state_is_saved_and_restored(reference, slave):
    every, step = list(references(slave).values()), reference.seconds / 60.0
    initialise(slave)
    slave.doStep(0.0, step)
    saved = slave.getFMUstate()
    stored = slave.serializeFMUstate(saved)
    slave.doStep(step, step)
    expected = slave.getReal(every)
    for state in (saved, slave.deSerializeFMUstate(stored)):
        slave.setFMUstate(state)
        slave.doStep(step, step)
        assert slave.getReal(every) == expected
        slave.freeFMUstate(state)


def test_input_is_unchanged_by_its_derivative(reference, slave):
    values = dict(zip(references(slave), driven(slave, reference), strict=True))
    assert {n: values[n] for n in reference.inputs} == {
        name: mean for name, (mean, _) in reference.inputs.items()
    }


def test_refuses_what_must_not_be_set(reference, slave):
    known = references(slave)
    initialise(slave)
    computed = next(n for n in known if n.startswith("der("))
    fixed = set(reference.parameters) - set(tunable(slave))
    forbidden = [next(iter(reference.states)), *fixed, computed, "time"]
    for variable in [*forbidden, *reference.outputs]:
        with pytest.raises(FMICallException):
            slave.setReal([known[variable]], [1.0])


def tunable(slave: Any) -> list[str]:
    description = fmpy.read_model_description(slave.unzipDirectory)
    return [v.name for v in description.modelVariables if v.variability == "tunable"]


def test_tunable_parameters_take_effect_between_steps(reference, slave):
    known, step = references(slave), reference.seconds / 60.0
    inputs = [mean + amplitude for mean, amplitude in reference.inputs.values()]
    slave.setReal([known[n] for n in reference.starts], list(reference.starts.values()))
    slave.setReal([known[n] for n in reference.inputs], inputs)
    initialise(slave)
    slave.doStep(0.0, step)
    x = np.array(slave.getReal([known[n] for n in reference.states]))
    rates = [known[f"der({state})"] for state in reference.states]
    for parameter in tunable(slave):
        changed = {**reference.parameters, parameter: 1.1 * reference.parameters[parameter]}
        slave.setReal([known[parameter]], [changed[parameter]])
        expected = reference.rates(x, [*inputs, step], list(changed.values()))
        np.testing.assert_allclose(slave.getReal(rates), expected, rtol=1e-9, atol=1e-12)
        slave.setReal([known[parameter]], [reference.parameters[parameter]])


@ONE
def test_refuses_an_unknown_value_reference(slave, messages):
    with pytest.raises(FMICallException):
        slave.getReal([99])
    with pytest.raises(FMICallException):
        slave.setReal([99], [1.0])
    assert len(messages) == 2
    assert all("value reference 99" in message for message in messages)


@ONE
def test_refuses_another_guid(slave, messages):
    other = FMU2Slave(
        guid="{other}",
        unzipDirectory=slave.unzipDirectory,
        modelIdentifier=slave.modelIdentifier,
        instanceName="other",
    )
    with pytest.raises(Exception, match="instantiate"):
        other.instantiate(callbacks=slave.callbacks)
    assert "the GUID differs" in messages.pop()


@ONE
def test_a_bad_parameter_is_reported(slave, messages):
    slave.setReal([references(slave)["m"]], [-1.0])
    with pytest.raises(FMICallException):
        initialise(slave)
    assert messages == ["mass must be positive, got -1"]


@ONE
def test_failed_step_is_reported_and_undone(slave, messages):
    known = references(slave)
    initialise(slave)
    before = slave.getReal(list(known.values()))
    slave.setReal([known["F"]], [float("inf")])
    with pytest.raises(FMICallException):
        slave.doStep(0.0, 0.02)
    assert messages == ["der(v) is not finite at time 0"]
    slave.setReal([known["F"]], [0.0])
    assert slave.getReal(list(known.values())) == before


@ONE
def test_step_must_begin_where_the_last_one_ended(slave):
    initialise(slave)
    slave.doStep(0.0, 0.02)
    with pytest.raises(FMICallException):
        slave.doStep(0.5, 0.02)
