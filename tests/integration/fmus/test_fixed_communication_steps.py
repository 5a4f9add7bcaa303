"""A decay that communicates every 0.1 s only, measured at other times, against its closed form."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from support.changed_fmus import with_description
from support.simulated import answer

from cluster_est import Parameter, Problem, fit
from cluster_est.methods.least_squares.method import LeastSquares
from workers.errors import ModelError
from workers.messages import Effect, Experiment, Input, Model, Outcome, Output, Solver

Give = Callable[[str, int], Path]

VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
STEP = 0.1
TIMES = np.array([0.0, 0.07, 0.1, 0.15, 0.3, 0.333, 0.9, 1.21, 1.99])
ON_GRID = np.isin(TIMES, [0.0, 0.1, 0.3, 0.9])


def model(fmu: Path, step: float | None = None, **options: int) -> Model:
    solver = Solver("fmu", step, **options)
    return Model(fmu.name, fmu.read_bytes(), "co_simulation", solver, ("k",))


def measured(times: np.ndarray, inputs: tuple[Input, ...] = (), name: str = "e") -> Experiment:
    times = np.asarray(times, np.float64)
    output = Output("y", times, 0.0 * times)
    return Experiment(name, float(times[0]), float(times[-1]), inputs, (output,))


def simulated(
    fmu: Path,
    k: float,
    inputs: tuple[Input, ...] = (),
    times: np.ndarray = TIMES,
    effects: tuple[Effect, ...] = (),
    coefficients: Sequence[float] = (),
) -> np.ndarray:
    """y at some times."""
    outcome = answer(model(fmu), measured(times, inputs), [k, *coefficients], "trajectory", effects)
    assert outcome.ok, outcome.message
    found = outcome.trajectory
    return found.values[np.searchsorted(found.times, times), 0]


@VERSIONS
def test_the_error_between_the_points_is_of_second_order(own_fmu: Give, fmi: int) -> None:
    """Linear interpolation of f errs by f'' h^2 / 8 at most; the scale of k is that of 1 / h."""
    errors = []
    for k in (1.0, 0.5, 0.25):
        error = np.abs(simulated(own_fmu("fixed_step", fmi), k) - np.exp(-k * TIMES))
        assert error[ON_GRID].max() < 1e-7  # the FMU's own Runge-Kutta steps
        assert error.max() < (k * STEP) ** 2 / 8.0
        errors.append(error.max())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.1)


@VERSIONS
def test_values_between_the_points_are_on_the_line(own_fmu: Give, fmi: int) -> None:
    fmu = own_fmu("fixed_step", fmi)
    points = np.arange(21) * STEP
    on_points = simulated(fmu, 0.7, times=points)
    found = simulated(fmu, 0.7)
    np.testing.assert_allclose(found, np.interp(TIMES, points, on_points), rtol=1e-14)
    assert found[ON_GRID].tobytes() == on_points[[0, 1, 3, 9]].tobytes()


@VERSIONS
def test_steps_begin_at_the_start_of_the_experiment(own_fmu: Give, fmi: int) -> None:
    late = simulated(own_fmu("fixed_step", fmi), 1.0, times=TIMES + 1000.05)
    np.testing.assert_allclose(late, simulated(own_fmu("fixed_step", fmi), 1.0), atol=1e-9)


@VERSIONS
def test_a_held_input_acts_from_the_next_point_on(own_fmu: Give, fmi: int) -> None:
    """dx/dt = u - k x, u jumps to 2 at 0.42 s, which the FMU is told at 0.5 s."""
    jump = Input("u", np.array([0.0, 0.42]), np.array([0.0, 2.0]), "hold")
    times = np.array([0.0, 0.4, 0.5, 1.0, 1.5])
    late = np.maximum(times - 0.5, 0.0)
    expected = np.exp(-times) + 2.0 * (1.0 - np.exp(-late))
    found = simulated(own_fmu("fixed_step", fmi), 1.0, (jump,), times)
    np.testing.assert_allclose(found, expected, atol=1e-6)


@VERSIONS
def test_a_linear_input_has_its_slope_where_the_fmu_takes_it(own_fmu: Give, fmi: int) -> None:
    """dx/dt = t - x from 1: x = t - 1 + 2 exp(-t). FMI 3.0 has no slopes: an error of order h."""
    ramp = Input("u", np.array([0.0, 0.05, 3.0]), np.array([0.0, 0.05, 3.0]))
    times = np.array([0.0, 0.2, 0.5, 1.0, 1.9])
    found = simulated(own_fmu("fixed_step", fmi), 1.0, (ramp,), times)
    close = 1e-6 if fmi == 2 else 0.06
    np.testing.assert_allclose(found, times - 1.0 + 2.0 * np.exp(-times), atol=close)


@VERSIONS
def test_effects_at_inputs_and_outputs(own_fmu: Give, fmi: int) -> None:
    fmu = own_fmu("fixed_step", fmi)
    constant = (Input("u", np.array([0.0, 2.0]), np.array([0.5, 0.5]), "hold"),)
    none = (Input("u", np.array([0.0, 2.0]), np.array([0.0, 0.0]), "hold"),)
    plain = simulated(fmu, 1.0, none)
    pushed = simulated(fmu, 1.0, none, effects=(Effect("e", "input u", "bias"),),
                       coefficients=[0.5])  # fmt: skip
    np.testing.assert_allclose(pushed, simulated(fmu, 1.0, constant), rtol=1e-12)
    raised = simulated(fmu, 1.0, none, effects=(Effect("e", "output y", "bias"),),
                       coefficients=[0.5])  # fmt: skip
    np.testing.assert_allclose(raised, plain + 0.5, rtol=1e-14)


@VERSIONS
def test_an_effect_with_states_of_its_own(own_fmu: Give, fmi: int) -> None:
    """An input through a lag of 5 ms: integrated in short steps within those of 0.1 s."""
    fmu = own_fmu("fixed_step", fmi)
    jump = (Input("u", np.array([0.0, 0.5]), np.array([0.0, 1.0]), "hold"),)
    times = np.sort(np.append(np.linspace(0.0, 1.9, 381), 0.333))
    lag = (Effect("e", "input u", "lag"),)
    lagged = simulated(fmu, 1.0, jump, times, lag, [0.005])
    plain = simulated(fmu, 1.0, jump, times)
    assert np.isfinite(lagged).all()
    np.testing.assert_allclose(lagged, plain, atol=0.11)  # a step late at most


def test_a_fit_finds_the_rate_and_says_what_it_did(own_fmu: Give) -> None:
    fmu = own_fmu("fixed_step", 2)
    output = Output("y", TIMES, np.exp(-0.8 * TIMES))
    runs = [Experiment(name, 0.0, 1.99, (), (output,)) for name in "ab"]
    rate = (Parameter("k", 1.0, 0.1, 3.0),)
    (note,) = Problem(model(fmu), rate, (runs[0], measured([0.0, 0.2], name="c"))).notes()
    assert re.search(r"every 0\.1 s; experiment 'a' has times between", note)
    problem = Problem(model(fmu), rate, tuple(runs))
    (note,) = problem.notes()
    assert "2 experiments have times between" in note
    result = fit(problem, LeastSquares())
    assert result.estimates[0].value == pytest.approx(0.8, abs=2e-3)


@pytest.fixture
def fixed(own_fmu: Give, tmp_path: Path) -> Callable[..., Path]:
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
    outcome = answer(model(fmu, step), measured(np.array(times)), [k])
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
    fixed: Callable[..., Path],
    named: float | None,
    internal: float | None,
    step: float | None,
    times: list[float],
    steps: int,
) -> None:
    """Multiples of it need no interpolation."""
    fmu = fixed(named, internal)
    outcome = outcome_of(fmu, times, step)
    assert outcome.steps == steps
    np.testing.assert_allclose(-outcome.residuals, np.exp(times[0] - np.array(times)), atol=1e-8)
    rate = (Parameter("k", 1.0, 0.1, 3.0),)
    assert Problem(model(fmu, step), rate, (measured(np.array(times)),)).notes() == ()


@pytest.mark.parametrize(
    ("times", "step", "said"),
    [
        ([0.0, 0.1, 0.25], None, r"experiment 'e'.*fixed length.*set model\.step"),
        ([0.0, 1.0], 1e-9, r"experiment 'e'.*more than model\.max_steps = 1000000"),
    ],
)
def test_times_without_a_step_that_fits_are_refused_with_advice(
    fixed: Callable[..., Path], times: list[float], step: float | None, said: str
) -> None:
    with pytest.raises(ModelError, match=said):
        outcome_of(fixed(), times, step)


def test_what_moves_at_events_alone_keeps_its_value(own_fmu: Give, tmp_path: Path) -> None:
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


@VERSIONS
@pytest.mark.parametrize("knot", [7 * 0.1, 0.7 + 1e-9])
def test_a_held_input_has_jumped_at_a_point_that_rounding_puts_before_it(
    own_fmu: Give, fmi: int, knot: float
) -> None:
    """7 * 0.1 > 0.7, and 0.7 is before it."""
    jump = Input("u", np.array([0.0, knot]), np.array([0.0, 2.0]), "hold")
    times = np.array([0.0, 0.7, 0.8, 1.5])
    late = np.maximum(times - 0.7, 0.0)
    expected = np.exp(-times) + 2.0 * (1.0 - np.exp(-late))
    found = simulated(own_fmu("fixed_step", fmi), 1.0, (jump,), times)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_inputs_between_the_points_are_linear_from_point_to_point(own_fmu: Give) -> None:
    fmu, times = own_fmu("fixed_step", 2), np.array([0.0, 0.1, 0.2, 0.4])
    between = Input("u", np.array([0.0, 0.15, 0.4]), np.array([0.0, 3.0, 3.0]))
    on_points = Input("u", np.array([0.0, 0.1, 0.2, 0.4]), np.array([0.0, 2.0, 3.0, 3.0]))
    found, expected = (simulated(fmu, 1.0, (u,), times) for u in (between, on_points))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
