"""What the compiled loops do with answers that the example FMUs never give.

The FMU is a set of C functions made of Python ones, called by their addresses as any FMU's are.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import c_double, c_int32, c_size_t, c_uint32, c_void_p

import numpy as np
import pytest

from workers.grid import Grid, build_grid
from workers.kernels import failure
from workers.kernels.co_simulation import co_simulate_batch
from workers.kernels.cvode import CvodeBatch
from workers.kernels.dormand_prince import dormand_prince_batch
from workers.kernels.fmi2 import Component, Constants, References, workspace
from workers.kernels.hooks import no_hooks
from workers.kernels.initialise import Settings
from workers.kernels.rk4 import rk4_batch
from workers.messages import Experiment, FloatArray, Output

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
    "new_discrete_states": (flags,),
    "enter_continuous_time_mode": (),
    "completed_integrator_step": (c_int32, flags, flags),
    "do_step": (c_double, c_double, c_int32),
}


class FakeFmu:
    """x' = -x, x(0) = 1, y = x; a test replaces the functions that should misbehave."""

    def __init__(self) -> None:
        self.time, self.x = 0.0, 1.0
        self.calls: list[str] = []

    def component(self, *, completes_steps: bool = True) -> Component:
        self._kept = [
            ctypes.CFUNCTYPE(c_int32, c_void_p, *signature)(self._counting(name))
            for name, signature in SIGNATURES.items()
        ]
        addresses = [ctypes.cast(function, c_void_p).value or 0 for function in self._kept]
        unused = set(Component._fields) - set(SIGNATURES)
        return Component(
            **dict.fromkeys(unused - {"interpolates_inputs", "completes_steps", "n_states"}, 0),
            **dict(zip(SIGNATURES, addresses, strict=True)),
            interpolates_inputs=False,
            completes_steps=completes_steps,
            n_states=1,
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

    def new_discrete_states(self, info: flags) -> int:
        info[0] = 0
        return OK

    def completed_integrator_step(self, prior: int, event: flags, terminate: flags) -> int:
        event[0] = terminate[0] = 0
        return OK

    def do_step(self, time: float, step: float, prior: int) -> int:
        self.time, self.x = time + step, self.x * np.exp(-step)
        return OK


BATCHES: dict[str, Callable[..., int]] = {
    "dormand_prince": dormand_prince_batch,
    "rk4": rk4_batch,
    "cvode": CvodeBatch(),
    "fmu": co_simulate_batch,
}
EXCHANGE = ["dormand_prince", "rk4", "cvode"]


def grid() -> Grid:
    return build_grid(Experiment("e", 0.0, 2.0, (), (Output("y", TIMES, 0.0 * TIMES),)))


def run(
    fmu: FakeFmu,
    solver: str | CvodeBatch,
    *,
    completes_steps: bool = True,
    n_states: int = 1,
    on: Grid | None = None,
) -> tuple[int, float, FloatArray]:
    """Simulate one point: its code, where it stopped and its outputs."""
    batch = BATCHES[solver] if isinstance(solver, str) else solver
    none, one = np.zeros(0, np.uint32), np.array([7], c_uint32)
    outputs, codes, stopped = np.full((1, 5, 1), np.nan), np.zeros(1, np.int64), np.zeros(1)
    tried = batch(
        fmu.component(completes_steps=completes_steps)._replace(n_states=n_states),
        References(none, none, none, none, one),
        Constants(np.zeros(0, np.int32), np.zeros(0, np.int32)),
        Settings(0.05 if solver == "rk4" else 0.0, 1e-8, np.full(n_states, 1e-8), 3000, 0.0),
        no_hooks(1),
        grid() if on is None else on,
        np.zeros((1, 0)),
        workspace(0, n_states),
        outputs,
        codes,
        stopped,
    )
    assert tried == 1
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
    "new_discrete_states",
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
@pytest.mark.parametrize(
    ("function", "place", "code"),
    [
        ("new_discrete_states", 1, failure.TERMINATED),
        ("new_discrete_states", 4, failure.EVENT),
        ("completed_integrator_step", 0, failure.EVENT),
        ("completed_integrator_step", 1, failure.TERMINATED),
    ],
)
def test_events_and_endings_by_the_fmu_are_reported(
    solver: str, function: str, place: int, code: int
) -> None:
    def new_discrete_states(info: flags) -> int:
        info[0], info[place] = 0, 1
        return OK

    def completed_integrator_step(prior: int, *both: flags) -> int:
        both[1 - place][0], both[place][0] = 0, int(fmu.time > 1.0)
        return OK

    fmu = FakeFmu()
    setattr(fmu, function, locals()[function])
    found, stopped, _ = run(fmu, solver)
    assert found == code
    assert stopped == 0.0 if function == "new_discrete_states" else 1.0 < stopped <= 1.5


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


def test_cvode_serves_arrays_of_other_types_with_another_right_hand_side() -> None:
    """It is compiled for the types that it is given; an integrator knows one only."""
    cvode, fmu = CvodeBatch(), FakeFmu()
    plain = grid()
    frozen = plain._replace(times=plain.times.copy())
    frozen.times.flags.writeable = False
    for given in (plain, frozen, plain):
        code, _, outputs = run(fmu, cvode, on=given)
        assert code == failure.FINISHED
        np.testing.assert_allclose(outputs, np.exp(-TIMES), rtol=1e-6)


@pytest.mark.parametrize("solver", EXCHANGE)
def test_there_may_be_nothing_to_integrate(solver: str) -> None:
    fmu = FakeFmu()
    fmu.x = 3.0
    code, _, outputs = run(fmu, solver, n_states=0)
    assert code == failure.FINISHED
    assert outputs.tolist() == [1.0] * len(TIMES)
