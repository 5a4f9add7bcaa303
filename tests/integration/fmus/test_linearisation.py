"""Linearisations against Jacobians worked out by hand, at states against SciPy."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems.driven_spring import driven, model_of
from support.problems.springs import ROOT
from support.simulated import Worker, answer, answers
from support.truth.springs_with_effects import FORCE, START, TIMES, C, K, M, plain, solve

from cluster_est.executors.local import LocalExecutor
from cluster_est.run_folder.evaluation_log import EvaluationLog
from cluster_est.run_folder.log_segment import read_log
from cluster_est.running.runner import Runner
from workers.errors import ModelError
from workers.messages import Effect, Experiment, Input, Model, Output, Solver, Status, Task
from workers.wire import TaskBatch

ADAPTIVE = Solver("dormand_prince", rtol=1e-11)
FIXED = Solver("rk4", step=0.001)
STIFF = Solver("cvode", rtol=1e-10)
SOLVERS = [ADAPTIVE, FIXED, STIFF]
SPRING = (M, K, C)
EXACT = {"rtol": 1e-8, "atol": 1e-8}


def asked(model, experiment, values, wants, effects=()):
    """The outcomes of one point, asked for one after the other, without their neighbours."""
    worker = Worker(model, experiment)
    tasks = [Task(0, 0, np.array(values), want, effects) for want in wants]
    found = [worker.evaluator.evaluate(TaskBatch.of([task]))[0] for task in tasks]
    worker.evaluator.close()
    assert all(outcome.ok for outcome in found), [outcome.message for outcome in found]
    assert len({outcome.residuals.tobytes() for outcome in found}) == 1
    return found


def linearised(model, experiment, values, effects=()):
    """A linearisation, whose simulation is the plain one to the last bit, before and after."""
    wants = ("trajectory", "linearisation", "trajectory")
    first, found, _ = asked(model, experiment, values, wants, effects)
    assert found.linearisation.outputs.tobytes() == first.trajectory.values.tobytes()
    assert found.linearisation.times.tobytes() == first.trajectory.times.tobytes()
    assert found.trajectory is None
    assert first.linearisation is None
    return found.linearisation


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("reset", ["reset", "instance"])
def test_the_first_thing_that_an_instance_is_asked_for(solver, reset):
    """A linearisation with CVODE simulates twice, each time from a beginning of its own."""
    model = replace(model_of(solver), reset=reset)
    wants = ("linearisation", "linearisation", "trajectory")
    first, again, _ = asked(model, driven(), SPRING, wants)
    assert first.linearisation.A.values.tobytes() == again.linearisation.A.values.tobytes()


def agrees(found, **matrices):
    """Each matrix has these rows, of entries that are numbers or a number for each time."""
    for name, rows in matrices.items():
        whole = [[np.broadcast_to(entry, len(found.times)) for entry in row] for row in rows]
        expected = np.moveaxis(np.array(whole, float), -1, 0)
        np.testing.assert_allclose(getattr(found, name), expected, **EXACT)


def spring_by_parameters(x, v, force, m=M):
    """df/d(m, k, c)."""
    zero = np.zeros_like(x)
    return [[zero, zero, zero], [-(force - K * x - C * v) / m**2, -x / m, -v / m]]


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_spring_has_the_textbook_matrices(solver):
    found = linearised(model_of(solver), driven(), SPRING)
    states = solve(plain)
    np.testing.assert_allclose(found.states, states, atol=1e-7)
    x, v = found.states.T
    acceleration = (FORCE - K * x - C * v) / M
    np.testing.assert_allclose(found.derivatives, np.column_stack([v, acceleration]), atol=1e-12)
    np.testing.assert_array_equal(found.inputs[:, 0], FORCE)
    np.testing.assert_array_equal(found.effective_inputs[:, 0], FORCE)
    np.testing.assert_array_equal(found.outputs[:, 0], x)
    np.testing.assert_array_equal(found.plain_outputs, found.outputs)
    agrees(found, A=[[0, 1], [-K / M, -C / M]], B=[[0], [1 / M]], C=[[1, 0]])
    np.testing.assert_array_equal(found.D, np.zeros((len(TIMES), 1, 1)), strict=True)
    np.testing.assert_array_equal(found.Q, np.zeros((len(TIMES), 1, 3)), strict=True)
    agrees(found, P=spring_by_parameters(x, v, FORCE))
    assert (found.state_names, found.input_names) == (("x", "v"), ("F",))
    assert (found.output_names, found.parameter_names) == (("y",), ("m", "k", "c"))


def test_only_tunable_parameters_have_derivatives_and_a_bound_is_not_crossed():
    """A damping of 0, its lower bound, and an initial position that is no parameter of the ODE."""
    model = model_of(ADAPTIVE, ("x", "c", "k"))
    experiment = replace(driven(), values=(("m", M),))
    found = linearised(model, experiment, (START[0], 0.0, K))
    assert found.parameter_names == ("c", "k")
    x, v = found.states.T
    np.testing.assert_allclose(found.P[:, 1], np.column_stack([-v / M, -x / M]), **EXACT)


def example(name, parameters):
    archive = (ROOT / "configs/models" / f"{name}.fmu").read_bytes()
    return Model(name, archive, "model_exchange", ADAPTIVE, parameters)


def fed(name, drive, outputs=("y",), values=()):
    times = np.linspace(0.0, 10.0, 60)
    measured = tuple(Output(output, times[1:], np.zeros(59)) for output in outputs)
    return Experiment("e", 0.0, 10.0, (Input(name, times, drive(times)),), measured, values)


def test_a_pendulum_far_from_hanging():
    inertia, gravity, friction = 0.12, 2.3, 0.05
    experiment = fed("torque", lambda t: 0.6 * np.sin(2 * t), values=(("angle", 1.5),))
    model = example("pendulum", ("J", "G", "b"))
    found = linearised(model, experiment, (inertia, gravity, friction))
    angle, speed = found.states.T
    torque = found.inputs[:, 0]
    assert np.ptp(angle) > 2.0
    rows = [[0, 1], [-gravity * np.cos(angle) / inertia, -friction / inertia]]
    agrees(found, A=rows, B=[[0], [1 / inertia]])
    moment = torque - gravity * np.sin(angle) - friction * speed
    rows = [[0, 0, 0], [-moment / inertia**2, -np.sin(angle) / inertia, -speed / inertia]]
    agrees(found, P=rows)


def test_inputs_that_nothing_drives_have_derivatives_too():
    """A motor whose data know no load torque: it is held at its start value."""
    model = example("dc_motor_belt", ("J_load",))
    experiment = fed("V", lambda t: np.sin(t), ("load_speed", "current"))
    experiment = replace(experiment, values=(("T_load", 0.01),))
    found = linearised(model, experiment, (6e-4,))
    assert found.input_names == ("V", "T_load")
    assert found.output_names == ("load_speed", "current")
    np.testing.assert_array_equal(found.effective_inputs[:, 1], 0.01)
    load = found.state_names.index("w_load")
    np.testing.assert_allclose(found.B[:, load, 1], -1 / 6e-4, rtol=1e-8)
    shown = [load, found.state_names.index("i")]
    assert (found.C.argmax(axis=2) == shown).all()


def test_a_term_at_a_derivative_a_lagged_input_and_an_effect_at_an_output():
    drag, tau, gain = 0.7, 0.1, 0.3
    effects = (
        Effect("lag", "input F", "lag"),
        Effect("drag", "der(v)", "cubic"),
        Effect("sensor", "output y", "gain"),
    )
    found = linearised(model_of(ADAPTIVE), driven(), (*SPRING, tau, drag, gain), effects)

    def slope(t, x, force):
        v, dv = plain(t, x, x[2])
        return [v, dv - drag * x[1] ** 3, (force - x[2]) / tau]

    np.testing.assert_allclose(found.states, solve(slope, (*START, FORCE[0])), atol=1e-7)
    assert found.state_names == ("x", "v", "lag:z")
    x, v, z = found.states.T
    np.testing.assert_array_equal(found.inputs[:, 0], FORCE)
    np.testing.assert_array_equal(found.effective_inputs[:, 0], z)
    rows = [[0, 1, 0], [-K / M, -C / M - 3 * drag * v**2, 1 / M], [0, 0, -1 / tau]]
    agrees(found, A=rows, B=[[0], [1 / M], [0]], C=[[1, 0, 0]])
    agrees(found, P=[*spring_by_parameters(x, v, z), [0, 0, 0]])
    np.testing.assert_array_equal(found.plain_outputs[:, 0], x)
    np.testing.assert_allclose(found.outputs[:, 0], (1 + gain) * x, rtol=1e-14)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_parameter_that_heats_up(solver):
    """Its derivative is by the value that holds at that time."""
    k, at, tau = 0.4, 0.1, 0.5
    effects = (Effect("hot", "parameter c", "heating", ("v",)),)
    found = linearised(model_of(solver), driven(), (*SPRING, k, at, tau), effects)
    assert found.state_names == ("x", "v", "hot:z")
    x, v, z = found.states.T
    damping = C * (1 + k * (z - at))
    acceleration = (FORCE - K * x - damping * v) / M
    np.testing.assert_allclose(
        found.derivatives, np.column_stack([v, acceleration, (v**2 - z) / tau]), atol=1e-12
    )
    rows = [[0, 1, 0], [-K / M, -damping / M, -C * k * v / M], [0, 2 * v / tau, -1 / tau]]
    agrees(found, A=rows, B=[[0], [1 / M], [0]])
    agrees(found, P=[[0, 0, 0], [-acceleration / M, -x / M, -v / M], [0, 0, 0]])


def test_an_effect_at_a_derivative_sees_a_changed_input_behind_the_effects_at_it():
    bias, gain, coupling = 0.5, 0.2, 2.0
    effects = (
        Effect("coupling", "der(v)", "product", ("x", "F")),
        Effect("bias", "input F", "bias"),
        Effect("gain", "input F", "gain"),
    )
    found = linearised(model_of(ADAPTIVE), driven(), (*SPRING, coupling, bias, gain), effects)
    x, _ = found.states.T
    edited = (FORCE + bias) * (1 + gain)
    np.testing.assert_allclose(found.effective_inputs[:, 0], edited, rtol=1e-14)
    rows = [[0, 1], [-K / M + coupling * edited, -C / M]]
    agrees(found, A=rows, B=[[0], [1 / M + coupling * x]])


def test_a_delayed_input_is_reported_on_the_grid_of_the_experiment():
    effects = (Effect("late", "input F", "delay"), Effect("drag", "der(v)", "viscous"))
    found = linearised(model_of(ADAPTIVE), driven(), (*SPRING, 0.013, 0.4), effects)
    np.testing.assert_array_equal(found.times, TIMES)
    late = np.interp(TIMES - 0.013, TIMES, FORCE)
    np.testing.assert_allclose(found.effective_inputs[:, 0], late, atol=1e-12)
    agrees(found, A=[[0, 1], [-K / M, -C / M - 0.4]])


def test_a_measured_signal_is_no_input():
    wind = np.cos(5.0 * TIMES)
    experiment = replace(driven(), signals=(Input("wind", TIMES + 0.001, wind),))
    effects = (Effect("wind", "der(v)", "linear", ("wind",)), Effect("bias", "input F", "bias"))
    found = linearised(model_of(ADAPTIVE), experiment, (*SPRING, 0.8, 0.5), effects)
    assert found.input_names == ("F",)
    x, v = found.states.T
    now = np.interp(TIMES, TIMES + 0.001, wind)
    acceleration = (FORCE + 0.5 - K * x - C * v) / M + 0.8 * now
    np.testing.assert_allclose(found.derivatives, np.column_stack([v, acceleration]), atol=1e-12)
    agrees(found, A=[[0, 1], [-K / M, -C / M]], B=[[0], [1 / M]])


def test_failures_are_outcomes_and_leave_their_neighbours_alone():
    points = [SPRING, (-1.0, K, C), (2.0, K, C), (np.nan, K, C), SPRING]
    tasks = [Task(i, 0, np.array(p), "linearisation") for i, p in enumerate(points)]
    outcomes = answers(model_of(ADAPTIVE), [driven()], tasks)
    assert [o.ok for o in outcomes] == [True, False, True, False, True]
    assert "mass must be positive, got -1" in outcomes[1].message
    assert outcomes[1].linearisation is None
    first, last = (outcomes[i].linearisation for i in (0, 4))
    assert first.P.tobytes() == last.P.tobytes()
    np.testing.assert_allclose(outcomes[2].linearisation.B[:, 1, 0], 0.5, rtol=1e-8)


def test_a_derivative_that_is_not_finite_is_said():
    """The root of a position has no derivative where the mass starts, at 0 and pushed upwards."""
    experiment = replace(
        driven(),
        values=(),
        stop=0.02,
        inputs=(Input("F", np.array([0.0]), np.array([5.0])),),
        outputs=(Output("y", np.array([0.02]), np.zeros(1)),),
    )
    effect = Effect("e", "der(v)", equation="k * sqrt(x)", coefficients=(("k", 0.0),))
    plain, outcome = (
        answer(model_of(FIXED), experiment, (*SPRING, 1.0), want, (effect,))
        for want in ("residuals", "linearisation")
    )
    assert plain.ok
    assert outcome.status is Status.NOT_FINITE
    assert outcome.message == "the derivative of 'der(v)' with respect to 'x' is nan at t = 0 s"


def test_co_simulation_is_refused():
    with pytest.raises(ModelError, match=r"provides only in model exchange.*co_simulation"):
        answer(model_of(Solver("fmu")), driven(), SPRING, "linearisation")


def test_the_runner_passes_it_on_and_the_log_leaves_it_out(tmp_path):
    model, experiment = model_of(ADAPTIVE), driven()
    log = EvaluationLog(tmp_path / "log", model.key, [(experiment.id, experiment.key)], {})
    with LocalExecutor.open(model, (experiment,), 2, None) as executor:
        runner = Runner(executor, record=log.record)
        values = np.array([SPRING, (2.0, K, C)])
        outcomes = runner.simulate(values, [0, 0], "linearisation", "response")
    log.close()
    inverse = [o.linearisation.B[7, 1, 0] for o in outcomes]
    np.testing.assert_allclose(inverse, [1 / M, 0.5], rtol=1e-8)
    table = read_log(tmp_path / "log")
    assert table["purpose"].to_pylist() == ["linearisation"] * 2
