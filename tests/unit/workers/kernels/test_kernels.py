"""What the compiled loops do with answers that the example FMUs never give.

The FMU is a set of C functions made of Python ones, called by their addresses as any FMU's are.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import c_double, c_int32, c_size_t, c_void_p

import numpy as np
import pytest

from workers.grid import SignalGrid, build_grid
from workers.kernels.fmi import failure
from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.fmi.component import (
    FmiComponent,
    StartValues,
    VariableReferences,
    nothing_loaded,
    workspace,
)
from workers.kernels.fmi.hooks import no_hooks
from workers.kernels.fmi.initialise import SolverSettings
from workers.kernels.fmi.values import VariableAccess
from workers.kernels.solvers.cvode import CvodeBatch
from workers.kernels.solvers.sundials import DirectionalJacobian
from workers.messages import Experiment, FloatArray, Output
from workers.simulation.integrator import BATCHES as LOOPS
from workers.simulation.integrator import Batch

OK, DISCARD, ERROR, FATAL = 0, 2, 3, 4
TIMES = np.linspace(0.0, 2.0, 5)

doubles = ctypes.POINTER(c_double)
flags = ctypes.POINTER(c_int32)
SIGNATURES = {
    "reset": (),
    "setup_experiment": (c_int32, c_double, c_double, c_int32, c_double),
    "enter_initialization_mode": (),
    "exit_initialization_mode": (),
    "set_real": (c_void_p, c_size_t, doubles),
    "get_real": (c_void_p, c_size_t, doubles),
    "set_time": (c_double,),
    "set_continuous_states": (doubles, c_size_t),
    "get_continuous_states": (doubles, c_size_t),
    "get_derivatives": (doubles, c_size_t),
    "update_discrete_states": (flags,),
    "enter_event_mode": (),
    "get_event_indicators": (doubles, c_size_t),
    "enter_continuous_time_mode": (),
    "completed_integrator_step": (c_int32, flags, flags),
    "do_step": (c_double, c_double, c_int32),
    "get_directional_derivative": (c_void_p, c_size_t, c_void_p, c_size_t, doubles, doubles),
}


class FakeFmu:
    """x' = -x, x(0) = 1, y = x; a test replaces the functions that should misbehave."""

    indicators = 0

    def __init__(self) -> None:
        self.time, self.x = 0.0, 1.0
        self.calls: list[str] = []

    def component(self, *, completes_steps: bool = True) -> FmiComponent:
        self._kept = [
            ctypes.CFUNCTYPE(c_int32, c_void_p, *signature)(self._counting(name))
            for name, signature in SIGNATURES.items()
        ]
        addresses = [ctypes.cast(function, c_void_p).value or 0 for function in self._kept]
        known = dict(zip(SIGNATURES, addresses, strict=True))
        return nothing_loaded("2.0")._replace(
            completes_steps=completes_steps,
            n_states=1,
            n_indicators=self.indicators,
            **known,
        )

    def _counting(self, name: str) -> Callable[..., int]:
        function = getattr(self, name, lambda *arguments: OK)

        def call(handle: int, *arguments: object) -> int:
            self.calls.append(name)
            return int(function(*arguments))

        return call

    def reset(self) -> int:
        self.time, self.x = 0.0, 1.0
        return OK

    def get_real(self, references: int, count: int, values: doubles) -> int:
        values[0] = self.x
        return OK

    def set_time(self, time: float) -> int:
        self.time = time
        return OK

    def set_continuous_states(self, states: doubles, count: int) -> int:
        self.x = states[0]
        return OK

    def get_continuous_states(self, states: doubles, count: int) -> int:
        states[0] = self.x
        return OK

    def get_derivatives(self, derivatives: doubles, count: int) -> int:
        derivatives[0] = -self.x
        return OK

    def get_directional_derivative(
        self, asked: int, n_asked: int, known: int, n_known: int, seed: doubles, found: doubles
    ) -> int:
        found[0] = -seed[0]
        return OK

    def update_discrete_states(self, info: flags) -> int:
        info[0] = 0
        return OK

    def completed_integrator_step(self, prior: int, event: flags, terminate: flags) -> int:
        event[0] = terminate[0] = 0
        return OK

    def do_step(self, time: float, step: float, prior: int) -> int:
        self.time, self.x = time + step, self.x * np.exp(-step)
        return OK


BATCHES: dict[str, Batch] = LOOPS | {"cvode": CvodeBatch()}
EXCHANGE = ["dormand_prince", "rk4", "cvode"]


def grid() -> SignalGrid:
    return build_grid(Experiment("e", 0.0, 2.0, (), (Output("y", TIMES, 0.0 * TIMES),)))


def reals(*references: int) -> VariableAccess:
    return VariableAccess(np.array(references, np.uint32), np.zeros((0, 5), np.int64))


def run(
    fmu: FakeFmu,
    solver: str | CvodeBatch,
    *,
    completes_steps: bool = True,
    n_states: int = 1,
    on: SignalGrid | None = None,
) -> tuple[int, float, FloatArray]:
    """Simulate one point: its code, where it stopped and its outputs."""
    batch = BATCHES[solver] if isinstance(solver, str) else solver
    none, one = reals(), reals(7)
    outputs, codes, stopped = np.full((1, 5, 1), np.nan), np.zeros(1, np.int64), np.zeros(1)
    atols = np.full(n_states, 1e-8)
    asked = KernelArguments(
        fmu.component(completes_steps=completes_steps)._replace(n_states=n_states),
        VariableReferences(none, none, one),
        StartValues(none, none, none.reals, np.zeros(0, np.int64)),
        SolverSettings(0.05 if solver == "rk4" else 0.0, 1e-8, 1e-8, atols, 3000, 0.0),
        no_hooks(1),
        grid() if on is None else on,
        np.zeros((1, 0)),
        np.full(1, np.inf),
        workspace(0, n_states, n_indicators=fmu.indicators),
        outputs,
        codes,
        stopped,
        np.zeros(1, np.int64),
    )
    assert batch(asked) == 1
    return int(codes[0]), float(stopped[0]), outputs[0, :, 0]


@pytest.mark.parametrize("completes_steps", [True, False])
@pytest.mark.parametrize("solver", list(BATCHES))
def test_fake_fmu_decays(solver: str, completes_steps: bool) -> None:
    fmu = FakeFmu()
    code, stopped, outputs = run(fmu, solver, completes_steps=completes_steps)
    assert (code, stopped) == (failure.FINISHED, 2.0)
    np.testing.assert_allclose(outputs, np.exp(-TIMES), rtol=1e-6)
    told = "completed_integrator_step" in fmu.calls
    assert told == (completes_steps and solver in EXCHANGE)


INITIAL = ["reset", "setup_experiment", "enter_initialization_mode", "exit_initialization_mode"]
ADVANCING = [
    "update_discrete_states",
    "enter_continuous_time_mode",
    "get_continuous_states",
    "set_time",
    "set_continuous_states",
    "get_derivatives",
    "completed_integrator_step",
]


@pytest.mark.parametrize("status", [DISCARD, ERROR, FATAL])
@pytest.mark.parametrize("solver", list(BATCHES))
@pytest.mark.parametrize("function", [*INITIAL, "get_real"])
def test_failing_call_ends_the_simulation(function: str, solver: str, status: int) -> None:
    fmu = FakeFmu()
    setattr(fmu, function, lambda *arguments: status)
    code, stopped, outputs = run(fmu, solver)
    expected = failure.OUTPUT if function == "get_real" else failure.INITIALISATION
    assert code == expected + (failure.FATAL if status == FATAL else 0)
    assert stopped == 0.0
    assert np.isnan(outputs).all()


@pytest.mark.parametrize("nth", [1, 2, 9])
@pytest.mark.parametrize(
    ("solver", "function"),
    [
        *((solver, name) for solver in BATCHES for name in [*INITIAL, "get_real"]),
        *((solver, name) for solver in EXCHANGE for name in ADVANCING),
        ("fmu", "do_step"),
    ],
)
def test_nothing_is_asked_after_a_fatal_status(solver: str, function: str, nth: int) -> None:
    fmu = FakeFmu()
    usual = getattr(fmu, function, lambda *arguments: OK)
    setattr(fmu, function, lambda *a: FATAL if fmu.calls.count(function) == nth else usual(*a))
    code, _, _ = run(fmu, solver)
    if fmu.calls.count(function) >= nth:
        assert fmu.calls[-1] == function
        assert code > failure.FATAL
    else:
        assert code == failure.FINISHED


@pytest.mark.parametrize("solver", EXCHANGE)
@pytest.mark.parametrize("function", ["update_discrete_states", "completed_integrator_step"])
def test_an_ending_by_the_fmu_is_reported(solver: str, function: str) -> None:
    def update_discrete_states(info: flags) -> int:
        info[0], info[1] = 0, 1
        return OK

    def completed_integrator_step(prior: int, event: flags, terminate: flags) -> int:
        event[0], terminate[0] = 0, int(fmu.time > 1.0)
        return OK

    fmu = FakeFmu()
    setattr(fmu, function, locals()[function])
    found, stopped, _ = run(fmu, solver)
    assert found == failure.TERMINATED
    assert stopped == 0.0 if function == "update_discrete_states" else 1.0 < stopped <= 1.5


@pytest.mark.parametrize("solver", EXCHANGE)
def test_an_event_after_a_step_is_handled_once(solver: str) -> None:
    """The FMU asks for an event after the first step behind 0.7 s; x is 5 then."""
    fmu = FakeFmu()
    asked: list[float] = []

    def completed_integrator_step(prior: int, event: flags, terminate: flags) -> int:
        event[0], terminate[0] = int(fmu.time > 0.7 and not asked), 0
        return OK

    def update_discrete_states(info: flags) -> int:
        for j in range(5):
            info[j] = 0
        if fmu.time > 0.0:
            asked.append(fmu.time)
            info[3], fmu.x = 1, 5.0
        return OK

    fmu.completed_integrator_step = completed_integrator_step  # type: ignore[method-assign]
    fmu.update_discrete_states = update_discrete_states  # type: ignore[method-assign]
    code, _, outputs = run(fmu, solver)
    assert code == failure.FINISHED
    (at,) = asked
    assert 0.7 < at <= 1.0
    expected = np.where(at <= TIMES, 5.0 * np.exp(at - TIMES), np.exp(-TIMES))
    np.testing.assert_allclose(outputs, expected, rtol=1e-6)


@pytest.mark.parametrize("at", [0.3, 0.5, 1.0000000000000002, 0.9999999999999999, 0.0, 2.0])
@pytest.mark.parametrize("solver", EXCHANGE)
def test_a_time_event_comes_in_time(solver: str, at: float) -> None:
    """x is 5 from the event on, also where it is at a time of the grid, but for rounding."""
    fmu = FakeFmu()
    begun: list[float] = []

    def update_discrete_states(info: flags) -> int:
        for j in range(5):
            info[j] = 0
        if not begun:
            info[4] = 1
            ctypes.cast(info, doubles)[3] = at
        elif fmu.time >= at:
            info[3], fmu.x = 1, 5.0
        begun.append(fmu.time)
        return OK

    fmu.update_discrete_states = update_discrete_states  # type: ignore[method-assign]
    code, _, outputs = run(fmu, solver)
    assert code == failure.FINISHED
    assert begun == [0.0, at]
    late = at - 1e-12 < TIMES
    if at == 0.0:
        late = TIMES > 0.0
    np.testing.assert_allclose(
        outputs, np.where(late, 5.0 * np.exp(at - TIMES), np.exp(-TIMES)), rtol=1e-6
    )


@pytest.mark.parametrize("solver", EXCHANGE)
@pytest.mark.parametrize("level", [0.9, 0.5, 0.13533528323661270])
def test_a_state_event_is_located(solver: str, level: float) -> None:
    """Where x crosses a level it is doubled; x is known on both sides."""
    fmu = FakeFmu()
    fmu.indicators = 1
    events: list[tuple[float, float]] = []

    def get_event_indicators(values: doubles, count: int) -> int:
        values[0] = fmu.x - level
        return OK

    def update_discrete_states(info: flags) -> int:
        for j in range(5):
            info[j] = 0
        if fmu.time > 0.0 and fmu.x <= level:
            events.append((fmu.time, fmu.x))
            info[3], fmu.x = 1, 2.0 * level
        return OK

    fmu.get_event_indicators = get_event_indicators  # type: ignore[attr-defined]
    fmu.update_discrete_states = update_discrete_states  # type: ignore[method-assign]
    code, _, outputs = run(fmu, solver)
    assert code == failure.FINISHED
    period = np.log(2.0)
    expected = [-np.log(level) + k * period for k in range(10)]
    expected = [t for t in expected if 1e-9 < t < 2.0]
    found = [t for t, _ in events]
    np.testing.assert_allclose(found[: len(expected)], expected, rtol=1e-6)
    passed = np.array([sum(t <= at + 1e-9 for t in found) for at in TIMES])
    np.testing.assert_allclose(outputs, np.exp(-TIMES) * 2.0**passed, rtol=1e-6)


@pytest.mark.parametrize("solver", EXCHANGE)
def test_events_without_end_are_a_failure(solver: str) -> None:
    fmu = FakeFmu()

    def update_discrete_states(info: flags) -> int:
        for j in range(5):
            info[j] = 0
        info[4] = 1
        ctypes.cast(info, doubles)[3] = max(fmu.time, 0.4)
        return OK

    fmu.update_discrete_states = update_discrete_states  # type: ignore[method-assign]
    code, stopped, _ = run(fmu, solver)
    assert (code, stopped) == (failure.CHATTERING, 0.4)


@pytest.mark.parametrize("solver", ["dormand_prince", "cvode"])
def test_discarded_step_is_tried_again_shorter(solver: str) -> None:
    tries = iter([OK, OK, OK, DISCARD])

    def get_derivatives(derivatives: doubles, count: int) -> int:
        derivatives[0] = -fmu.x
        return next(tries, OK)

    fmu = FakeFmu()
    fmu.get_derivatives = get_derivatives  # type: ignore[method-assign]
    code, _, outputs = run(fmu, solver)
    assert code == failure.FINISHED
    np.testing.assert_allclose(outputs, np.exp(-TIMES), rtol=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
@pytest.mark.parametrize("since", [-1.0, 0.7])
@pytest.mark.parametrize("solver", ["dormand_prince", "cvode"])
def test_derivative_out_of_range_ends_adaptive_solvers(
    solver: str, value: float, since: float
) -> None:
    def get_derivatives(derivatives: doubles, count: int) -> int:
        derivatives[0] = value if fmu.time > since else -fmu.x
        return OK

    fmu = FakeFmu()
    fmu.get_derivatives = get_derivatives  # type: ignore[method-assign]
    code, stopped, outputs = run(fmu, solver)
    if code == failure.FINISHED:
        assert not np.isfinite(outputs).all() or outputs[-1] > 1e299
    else:
        assert code == failure.STEP_TOO_SMALL
        assert stopped == pytest.approx(max(since, 0.0), abs=1e-6)
    assert len(fmu.calls) < 100_000


def test_cvode_serves_arrays_of_other_types_with_other_callbacks() -> None:
    """It is compiled for the types that it is given; an integrator knows one only."""
    cvode, fmu = CvodeBatch(), FakeFmu()
    plain = grid()
    frozen = plain._replace(times=plain.times.copy())
    frozen.times.flags.writeable = False
    for given in (plain, frozen, plain):
        code, _, outputs = run(fmu, cvode, on=given)
        assert code == failure.FINISHED
        np.testing.assert_allclose(outputs, np.exp(-TIMES), rtol=1e-6)


def with_jacobian() -> CvodeBatch:
    cvode = CvodeBatch()
    cvode.jacobian = DirectionalJacobian.of([0], [1])
    return cvode


def test_cvode_takes_its_jacobian_from_the_fmu() -> None:
    fmu, other = FakeFmu(), FakeFmu()
    code, _, outputs = run(fmu, with_jacobian())
    assert code == failure.FINISHED
    np.testing.assert_allclose(outputs, np.exp(-TIMES), rtol=1e-6)
    assert "get_directional_derivative" in fmu.calls
    run(other, "cvode")
    assert "get_directional_derivative" not in other.calls
    assert fmu.calls.count("get_derivatives") < other.calls.count("get_derivatives")


@pytest.mark.parametrize(
    ("status", "code"), [(DISCARD, failure.STEP_TOO_SMALL), (ERROR, failure.STEP)]
)
def test_an_fmu_may_refuse_to_give_its_jacobian(status: int, code: int) -> None:
    fmu = FakeFmu()
    fmu.get_directional_derivative = lambda *arguments: status  # type: ignore[method-assign]
    assert run(fmu, with_jacobian())[0] == code


@pytest.mark.parametrize("solver", EXCHANGE)
def test_there_may_be_nothing_to_integrate(solver: str) -> None:
    fmu = FakeFmu()
    fmu.x = 3.0
    code, _, outputs = run(fmu, solver, n_states=0)
    assert code == failure.FINISHED
    assert outputs.tolist() == [1.0] * len(TIMES)
