"""A decay that communicates every 0.1 s only, measured at other times, against its closed form."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.changed_fmus import with_description
from support.problems.driven_spring import model_of
from support.simulated import answer

from cluster_est import Parameter, Problem, fit
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from workers.errors import ModelError
from workers.messages import Effect, Experiment, Input, Model, Outcome, Output, Solver

STEP = 0.1
TIMES = np.array([0.0, 0.07, 0.1, 0.15, 0.3, 0.333, 0.9, 1.21, 1.99])
ON_GRID = np.isin(TIMES, [0.0, 0.1, 0.3, 0.9])


@pytest.fixture(params=[2, pytest.param(3, marks=pytest.mark.slow)])
def fmi(request):
    return request.param


@pytest.fixture
def fmu(own_fmu, fmi):
    return own_fmu("fixed_step", fmi)


def decay(fmu: Path, step: float | None = None) -> Model:
    return model_of(Solver("fmu", step), ("k",), fmu)


def measured(times: np.ndarray, inputs: tuple[Input, ...] = (), name: str = "e") -> Experiment:
    times = np.asarray(times, np.float64)
    output = Output("y", times, 0.0 * times)
    return Experiment(name, float(times[0]), float(times[-1]), inputs, (output,))


def simulated(fmu, k, inputs=(), times=TIMES, effects=(), coefficients=()):
    """y at some times."""
    outcome = answer(decay(fmu), measured(times, inputs), [k, *coefficients], "trajectory", effects)
    assert outcome.ok, outcome.message
    found = outcome.trajectory
    return found.values[np.searchsorted(found.times, times), 0]


def test_the_error_between_the_points_is_of_second_order(fmu):
    """Linear interpolation of f errs by f'' h^2 / 8 at most; the scale of k is that of 1 / h."""
    errors = []
    for k in (1.0, 0.5, 0.25):
        error = np.abs(simulated(fmu, k) - np.exp(-k * TIMES))
        assert error[ON_GRID].max() < 1e-7  # the FMU's own Runge-Kutta steps
        assert error.max() < (k * STEP) ** 2 / 8.0
        errors.append(error.max())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.1)


def test_values_between_the_points_are_on_the_line(fmu):
    points = np.arange(21) * STEP
    on_points = simulated(fmu, 0.7, times=points)
    found = simulated(fmu, 0.7)
    np.testing.assert_allclose(found, np.interp(TIMES, points, on_points), rtol=1e-14)
    assert found[ON_GRID].tobytes() == on_points[[0, 1, 3, 9]].tobytes()


def test_steps_begin_at_the_start_of_the_experiment(fmu):
    late = simulated(fmu, 1.0, times=TIMES + 1000.05)
    np.testing.assert_allclose(late, simulated(fmu, 1.0), atol=1e-9)


@pytest.mark.parametrize(("knot", "told"), [(0.42, 0.5), (7 * 0.1, 0.7), (0.7 + 1e-9, 0.7)])
def test_a_held_input_acts_from_the_next_point_on(fmu, knot, told):
    """dx/dt = u - k x, u jumps to 2. It has jumped at 0.7 s also where rounding puts that before.

    7 * 0.1 > 0.7.
    """
    jump = Input("u", [0.0, knot], [0.0, 2.0], "hold")
    times = np.array([0.0, 0.4, 0.5, 0.7, 0.8, 1.5])
    late = np.maximum(times - told, 0.0)
    expected = np.exp(-times) + 2.0 * (1.0 - np.exp(-late))
    np.testing.assert_allclose(simulated(fmu, 1.0, (jump,), times), expected, atol=1e-6)


def test_a_linear_input_has_its_slope_where_the_fmu_takes_it(fmu, fmi):
    """dx/dt = t - x from 1: x = t - 1 + 2 exp(-t). FMI 3.0 has no slopes: an error of order h."""
    ramp = Input("u", np.array([0.0, 0.05, 3.0]), np.array([0.0, 0.05, 3.0]))
    times = np.array([0.0, 0.2, 0.5, 1.0, 1.9])
    found = simulated(fmu, 1.0, (ramp,), times)
    close = 1e-6 if fmi == 2 else 0.06
    np.testing.assert_allclose(found, times - 1.0 + 2.0 * np.exp(-times), atol=close)


def test_effects_at_inputs_and_outputs(fmu):
    none, constant = ((Input("u", [0.0, 2.0], [u, u], "hold"),) for u in (0.0, 0.5))
    pushed, raised = (
        simulated(fmu, 1.0, none, effects=(Effect("e", site, "bias"),), coefficients=[0.5])
        for site in ("input u", "output y")
    )
    np.testing.assert_allclose(pushed, simulated(fmu, 1.0, constant), rtol=1e-12)
    np.testing.assert_allclose(raised, simulated(fmu, 1.0, none) + 0.5, rtol=1e-14)


def test_an_effect_with_states_of_its_own(fmu):
    """An input through a lag of 5 ms: integrated in short steps within those of 0.1 s."""
    jump = (Input("u", np.array([0.0, 0.5]), np.array([0.0, 1.0]), "hold"),)
    times = np.sort(np.append(np.linspace(0.0, 1.9, 381), 0.333))
    lag = (Effect("e", "input u", "lag"),)
    lagged = simulated(fmu, 1.0, jump, times, lag, [0.005])
    plain = simulated(fmu, 1.0, jump, times)
    assert np.isfinite(lagged).all()
    np.testing.assert_allclose(lagged, plain, atol=0.11)  # a step late at most


def test_a_fit_finds_the_rate_and_says_what_it_did(own_fmu):
    fmu = own_fmu("fixed_step", 2)
    output = Output("y", TIMES, np.exp(-0.8 * TIMES))
    runs = [Experiment(name, 0.0, 1.99, (), (output,)) for name in "ab"]
    rate = (Parameter("k", 1.0, (0.1, 3.0)),)
    (note,) = Problem(decay(fmu), rate, (runs[0], measured([0.0, 0.2], name="c"))).notes()
    assert re.search(r"steps of 0\.1 s, but experiment 'a' has samples between", note)
    problem = Problem(decay(fmu), rate, tuple(runs))
    (note,) = problem.notes()
    assert "2 experiments have samples between" in note
    result = fit(problem, LeastSquares())
    assert result.estimates[0].value == pytest.approx(0.8, abs=2e-3)


@pytest.fixture
def fixed(own_fmu, tmp_path):
    """A decay that takes any step and is described as if all had to be alike."""

    def give(named: float | None = None, internal: float | None = None) -> Path:
        said = 'canHandleVariableCommunicationStepSize="true"'
        changes = {said: said.replace("true", "false")}
        changes[' stepSize="0.1"'] = "" if named is None else f' stepSize="{named}"'
        if internal is not None:
            changes[said] = f'{changes.pop(said)} fixedInternalStepSize="{internal}"'
        return with_description(own_fmu("dahlquist", 3), tmp_path / "fixed.fmu", changes)

    return give


def outcome_of(fmu: Path, times: list[float], step: float | None = None, k: float = 1.0) -> Outcome:
    outcome = answer(decay(fmu, step), measured(np.array(times)), [k])
    assert outcome.ok, outcome.message
    return outcome


@pytest.mark.parametrize(
    ("named", "internal", "step", "times", "steps"),
    [
        (None, None, None, [0.0, 0.1, 0.2], 2),
        (None, None, None, [0.0, 0.1, 0.3, 0.4], 4),
        (None, None, 0.05, [0.0, 0.15, 0.25], 5),
        (None, None, 0.1, [5.0, 5.3, 105.0], 1000),
        (0.2, 0.05, 0.1, [0.0, 0.3, 0.6], 6),
        (0.2, 0.05, None, [0.0, 0.3, 0.6], 12),
        (0.1, None, None, [0.0, 0.3, 0.6], 6),
        (0.0, None, None, [0.0, 0.3, 0.6], 2),
    ],
)
def test_the_step_is_the_configured_one_or_the_fmus_own_or_one_that_fits_all_times(
    fixed, named, internal, step, times, steps
):
    """Multiples of it need no interpolation."""
    fmu = fixed(named, internal)
    outcome = outcome_of(fmu, times, step)
    assert outcome.steps == steps
    np.testing.assert_allclose(-outcome.residuals, np.exp(times[0] - np.array(times)), atol=1e-8)
    rate = (Parameter("k", 1.0, (0.1, 3.0)),)
    assert Problem(decay(fmu, step), rate, (measured(np.array(times)),)).notes() == ()


@pytest.mark.parametrize(
    ("times", "step", "said"),
    [
        ([0.0, 0.1, 0.25], None, r"experiment 'e'.*fixed communication step.*set model\.step"),
        ([0.0, 1.0], 1e-9, r"experiment 'e'.*more than model\.max_steps = 1000000"),
    ],
)
def test_times_without_a_step_that_fits_are_refused_with_advice(fixed, times, step, said):
    with pytest.raises(ModelError, match=said):
        outcome_of(fixed(), times, step)


def test_what_moves_at_events_alone_keeps_its_value(own_fmu, tmp_path):
    """A counter that is 1 at first and one more after each second."""
    said = 'canHandleVariableCommunicationStepSize="true"'
    changes = {said: said.replace("true", "false")}
    fmu = with_description(own_fmu("stair", 2), tmp_path / "stair.fmu", changes)
    times = np.array([0.0, 0.4, 1.1, 1.3, 2.1])
    outputs = tuple(Output(name, times, 0.0 * times) for name in ("counter", "y"))
    run = Experiment("e", 0.0, 2.1, (), outputs)
    steps = Model(fmu.name, fmu.read_bytes(), "co_simulation", Solver("fmu", 0.4), ())
    outcome = answer(steps, run)
    assert outcome.ok, outcome.message
    assert outcome.residuals.tolist() == [-1.0, -1.0, -1.0, -2.0, -3.0] * 2


def test_inputs_between_the_points_are_linear_from_point_to_point(own_fmu):
    fmu, times = own_fmu("fixed_step", 2), np.array([0.0, 0.1, 0.2, 0.4])
    between = Input("u", np.array([0.0, 0.15, 0.4]), np.array([0.0, 3.0, 3.0]))
    on_points = Input("u", np.array([0.0, 0.1, 0.2, 0.4]), np.array([0.0, 2.0, 3.0, 3.0]))
    found, expected = (simulated(fmu, 1.0, (u,), times) for u in (between, on_points))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
