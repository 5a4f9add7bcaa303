"""FMUs of OpenModelica and PythonFMU, in every interface: against fmpy, SciPy and closed forms."""

import fmpy
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.simulated import answers
from support.third_party import third_party_fmus
from try_fmus import compare_curves, trial

from workers.fmu.description import describe
from workers.messages import Experiment, Input, Limits, Model, Output, Solver, Task
from workers.process.supervisor import SupervisedEvaluator
from workers.wire import TaskBatch

SPRINGS = ("MassSpringSubSystem1", "MassSpringSubSystem2", "MassSpringSystem")
OPENMODELICA = ("Mass_Damper", *SPRINGS, "add", "ramp")
INTERFACES = ("model_exchange", "co_simulation")
TIMES = np.linspace(0.0, 5.0, 51)


@pytest.fixture(scope="session")
def fmus(tmp_path_factory):
    if fmpy.platform != "linux64":
        pytest.skip("the third-party FMUs hold binaries for a 64-bit Linux")
    found = third_party_fmus(tmp_path_factory.mktemp("third_party"))
    if found is None:
        pytest.skip("the third-party FMUs could not be fetched; CLUSTER_EST_FMUS may name a folder")
    return found


def simulated(file, interface, outputs, values=(), inputs=()):
    """(times, outputs), of the second simulation of a process."""
    exchange = interface == "model_exchange"
    solver = Solver("dormand_prince", rtol=1e-9) if exchange else Solver("fmu", 0.001)
    model = Model(file.name, file.read_bytes(), interface, solver, ())
    asked = tuple(Output(name, TIMES, 0.0 * TIMES) for name in outputs)
    guard = SupervisedEvaluator(
        model, [Experiment("e", 0.0, 5.0, inputs, asked, values)], "w", Limits(60.0)
    )
    batch = TaskBatch.of([Task(i, 0, np.zeros(0), "trajectory") for i in range(2)])
    _, outcome = guard.evaluate(batch)
    guard.close()
    assert outcome.ok, outcome.message
    return outcome.trajectory.values[np.searchsorted(outcome.trajectory.times, TIMES)]


@pytest.mark.parametrize("name", [*OPENMODELICA, "FMU3Model"])
def test_every_interface_agrees_with_fmpy_also_after_a_reset(fmus, name):
    file = fmus / f"{name}.fmu"
    description = describe(file.name, file.read_bytes())
    expected = ("co_simulation",) if name == "FMU3Model" else INTERFACES
    assert description.interfaces == expected
    for interface in expected:
        assert compare_curves(trial(file, description, interface, 101), 60.0).startswith("agrees: ")


@pytest.mark.parametrize("interface", INTERFACES)
def test_two_masses(fmus, interface):
    """Two masses between three springs, with values of our own, against SciPy."""
    m1, m2, k1, k2, k3 = 1.5, 0.7, 3.0, 2.0, 5.0
    chosen = (("m1", m1), ("m2", m2), ("k1", k1), ("k2", k2), ("k3", k3))
    states = tuple((f"_D_outputAlias_{n}", v) for n, v in zip(STATES, START, strict=True))
    found = simulated(
        fmus / "MassSpringSystem.fmu", interface, STATES, states,
        tuple(Input(n, TIMES[[0, -1]], np.full(2, v), "hold") for n, v in chosen),
    )  # fmt: skip

    def rates(_: float, x: np.ndarray) -> list[float]:
        middle = k2 * (x[1] - x[0])
        return [x[2], x[3], (middle - k1 * x[0]) / m1, (-middle - k3 * x[1]) / m2]

    exact = solve_ivp(rates, (0.0, 5.0), START, "DOP853", TIMES, rtol=1e-11, atol=1e-12).y.T
    np.testing.assert_allclose(found, exact, atol=1e-7 if interface == "model_exchange" else 0.03)


STATES = ("x1", "x2", "v1", "v2")
START = (0.3, -0.2, 1.0, 0.5)


@pytest.mark.parametrize("interface", INTERFACES)
def test_a_ramp_begins_and_ends_at_events(fmus, interface):
    """An FMU without states."""
    values = (("ramp.startTime", 1.05), ("ramp.duration", 2.5), ("ramp.height", 3.0))
    (found,) = simulated(fmus / "ramp.fmu", interface, ("out",), values).T
    expected = 3.0 * np.clip((TIMES - 1.05) / 2.5, 0.0, 1.0)
    np.testing.assert_allclose(
        found, expected, atol=1e-9 if interface == "model_exchange" else 4e-3
    )


@pytest.mark.parametrize("interface", INTERFACES)
def test_a_sum_of_inputs(fmus, interface):
    """An FMU without states or events, whose inputs come from data."""
    first = Input("u1", TIMES, np.sin(TIMES))
    second = Input("u2", TIMES, np.cos(TIMES))
    (found,) = simulated(fmus / "add.fmu", interface, ("y",), (("add.k1", 2.0),), (first, second)).T
    np.testing.assert_allclose(found, 2.0 * np.sin(TIMES) + np.cos(TIMES), atol=1e-12)


def test_a_model_in_python_counts_its_steps(fmus):
    """FMI 3.0, with an array: each step adds `increment` to 3 + increment * input."""
    file = fmus / "FMU3Model.fmu"
    model = Model(file.name, file.read_bytes(), "co_simulation", Solver("fmu"), ("increment",))
    run = Experiment("e", 0.0, 5.0, (), (Output("output", TIMES, 0.0 * TIMES),))
    tasks = [Task(i, 0, np.array([x]), "trajectory") for i, x in enumerate((0.5, 2.0))]
    for x, outcome in zip((0.5, 2.0), answers(model, [run], tasks), strict=True):
        assert outcome.ok, outcome.message
        np.testing.assert_allclose(outcome.trajectory.values[:, 0], 3.0 + x * np.arange(51))
