"""An FMU that fails at any call: a code with a time and an index, and no further call."""

import ctypes
from ctypes import addressof

import numpy as np
import pytest
from support.thinning import thinned

from workers.core import build
from workers.core import library as c
from workers.core.sundials import CvodeIntegrator

TIMES = np.linspace(0.0, 2.2, 12)
DISCARD, ERROR, FATAL, PENDING = 2, 3, 4, 5
SOURCE = build.HERE.parents[1] / "tests" / "support" / "failing_fmu.c"
CASES = thinned(
    [
        (method, fmi, status)
        for method in c.METHODS
        for fmi in (2, 3)
        for status in (DISCARD, ERROR, FATAL, PENDING)
    ],
    lambda method, fmi, _: (method, fmi),
    lambda method, _, status: (method, status),
)


class State(ctypes.Structure):
    _fields_ = [
        *((n, ctypes.c_int64) for n in ("calls", "fail_at", "fail_with", "completes")),
        *((n, ctypes.c_double) for n in ("t", "x", "u", "k", "next")),
    ]


@pytest.fixture(scope="module")
def binary(tmp_path_factory):
    target = tmp_path_factory.mktemp("fmu") / "failing.so"
    flags = ("-std=c11", "-O1", "-fPIC", "-shared")
    build.compile_to(target, [SOURCE], flags)
    found = ctypes.CDLL(str(target))
    found.state.restype = ctypes.POINTER(State)
    return found


def address(binary, name):
    return ctypes.cast(getattr(binary, name), ctypes.c_void_p).value


def fmu_of(binary, fmi, exchange):
    versioned = ("set_up", "update", "completed", "do_step", "get_real", "set_real")
    at = {name: address(binary, f"{name}{fmi}") for name in versioned}
    plain = address(binary, "just_count")
    fmu = c.Fmu(
        handle=1,
        reset=address(binary, "reset2"),
        setup_experiment=at["set_up"],
        enter_initialization_mode=at["set_up"] if fmi == 3 else plain,
        exit_initialization_mode=plain,
        set_time=address(binary, "set_time"),
        set_continuous_states=address(binary, "set_states"),
        get_continuous_states=address(binary, "get_states"),
        get_derivatives=address(binary, "get_derivatives"),
        get_event_indicators=address(binary, "get_indicators"),
        enter_event_mode=plain,
        update_discrete_states=at["update"],
        enter_continuous_time_mode=plain,
        completed_integrator_step=at["completed"],
        do_step=at["do_step"],
        stop_unit=-1.0,
        version=fmi,
        completes_steps=exchange,
        n_states=int(exchange),
        n_indicators=int(exchange),
    )
    fmu.get[0], fmu.set[0] = at["get_real"], at["set_real"]
    return fmu


class Simulation:
    """One simulation of the FMU, again and again."""

    def __init__(self, binary, method, fmi):
        exchange = method != "fmu"
        self.state = binary.state().contents
        self.arrays = {
            "one": np.array([0], np.uint32), "k": np.array([1], np.uint32),
            "values": np.cos(TIMES)[:, None].copy(), "slopes": np.zeros((len(TIMES), 1)),
            "intervals": np.diff(TIMES, append=TIMES[-1:]), "jumps": np.zeros(len(TIMES), np.uint8),
            "passed": np.zeros(len(TIMES), np.uint8),
            "atols": np.full(1, 1e-6), "points": np.ones((1, 1)), "progress": np.zeros(4, np.int64),
            "codes": np.zeros(1, np.int64), "indices": np.zeros(1, np.int64),
            "steps": np.zeros(1, np.int64), "stopped": np.zeros(1),
            "outputs": np.zeros((1, len(TIMES), 1)),
        }  # fmt: skip
        at = {name: array.ctypes.data for name, array in self.arrays.items()}
        one, k, none = c.Variables(at["one"], 0, 1, 0), c.Variables(at["k"], 0, 1, 0), c.Variables()
        self.parts = [
            fmu_of(binary, fmi, exchange),
            c.Experiment(
                stop=TIMES[-1], structure=none, numbers=k, inputs=one, continuous_inputs=one,
                outputs=one, times=TIMES.ctypes.data, intervals=at["intervals"],
                values=at["values"], slopes=at["slopes"], jumps=at["jumps"], passed=at["passed"],
                n_times=len(TIMES), n_inputs=1, n_outputs=1,
            ),
            c.Settings(0.0, 1e-6, 1e-6, at["atols"], 1000, 0.0, 0.0),
            c.Effects(),
        ]  # fmt: skip
        self.batch = c.Batch(
            *map(addressof, self.parts), c.METHODS[method], 1, 1, int(exchange), 1, at["points"], 0,
            at["progress"], at["outputs"], at["codes"], at["indices"], at["steps"], at["stopped"],
        )  # fmt: skip
        if method == "cvode":
            self.cvode = CvodeIntegrator(1)
            self.batch.cvode = self.cvode.address

    def run(self, fail_at, status):
        """Returns the code, the index and the calls."""
        self.state.calls, self.state.fail_at, self.state.fail_with = 0, fail_at, status
        assert c.core().core_simulate(addressof(self.batch)) == 1
        return (int(self.arrays[n][0]) for n in ("codes", "indices"))


@pytest.mark.parametrize(("method", "fmi", "status"), CASES)
def test_it_ends_with_a_code_and_no_further_call(binary, method, fmi, status):
    simulation = Simulation(binary, method, fmi)
    code, index = simulation.run(-1, 0)
    assert (code, index) == (0, len(TIMES) - 1)
    total, found = int(simulation.state.calls), set()
    for n in range(total):
        code, index = simulation.run(n, status)
        again = status == DISCARD and method in ("dormand_prince", "cvode") and code == 0
        if again:  # a shorter step was tried
            continue
        assert simulation.state.calls == n + 1 or (method == "cvode" and status == DISCARD)
        assert (code >= 100) == (status >= FATAL), (n, code)
        assert 0 <= index < len(TIMES)
        assert TIMES[0] <= simulation.arrays["stopped"][0] <= TIMES[-1]
        found.add(code % 100)
    assert found <= {1, 2, 3, 7, 11, 12}, found
    assert {1, 3} <= found
    code, _ = simulation.run(-1, 0)
    assert code == 0
    assert simulation.state.calls == total
