"""Columns, times and clocks that are wrong in all records; the data are SciPy's."""

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim
from support.problems.springs import FMU, TRUE

import cluster_est as ce

TIMES = 0.02 * np.arange(300)
ONE = ce.Resources(workers=1)
NOISE = 0.003
BEGIN = 0.2
"""Every spring begins stretched, so that a factor of its position is not one of the force."""
WARM = {"C_core": 55.0, "C_case": 170.0, "R_core_case": 1.8, "R_case_ambient": 3.6}


def springs(force=1.0, position=1.0, time=1.0, known=(), right=(), begin=BEGIN):
    """Records of a spring, written down with wrong factors; those in `right` are not wrong."""
    m, k, c = TRUE["m"], TRUE["k"], TRUE["c"]
    system = StateSpace([[0.0, 1.0], [-k / m, -c / m]], [[0.0], [1.0 / m]], [[1.0, 0.0]], [[0.0]])
    runs = []
    for number in range(4):
        random = np.random.default_rng([8, number])
        pushed = np.interp(TIMES, TIMES[::25], random.uniform(-3.0, 3.0, 12))
        y = lsim(system, pushed, TIMES, X0=[begin, 0.0])[1] + NOISE * random.normal(size=300)
        f, p, t = (1.0, 1.0, 1.0) if number in right else (force, position, time)
        given = ce.Input("F", t * TIMES, f * pushed)
        seen = ce.Output("y", t * TIMES, p * y, p * NOISE)
        runs.append(
            ce.Experiment(
                f"run {number}", 0.0, t * TIMES[-1], (given,), (seen,), (("x", begin),),
                role="test" if number == 3 else "train",
            )
        )  # fmt: skip
    solver = ce.Solver("dormand_prince")
    model = ce.Model(FMU.name, FMU.read_bytes(), "model_exchange", solver, ("m", "k", "c"))
    starts = {"m": (1.0, 0.5, 2.0), "k": (25.0, 10.0, 60.0), "c": (0.5, 0.2, 2.0)}
    return ce.Problem(
        model,
        [
            ce.Parameter(name, TRUE[name], fixed=True)
            if name in known
            else ce.Parameter(name, start, bounds=bounds)
            for name, (start, *bounds) in starts.items()
        ],
        runs,
    )


def rooms(offset=0.0, late=0.0):
    """Records of a warm core in a case; the case's thermometer or the clock of both is wrong."""
    cc, cs, across, lost = WARM.values()
    times = 10.0 * np.arange(300)
    system = StateSpace(
        [[-1.0 / (cc * across), 1.0 / (cc * across)],
         [1.0 / (cs * across), -(1.0 / across + 1.0 / lost) / cs]],
        [[1.0 / cc, 0.0], [0.0, 1.0 / (cs * lost)]], np.eye(2), np.zeros((2, 2)),
    )  # fmt: skip
    runs = []
    for number in range(4):
        random = np.random.default_rng([9, number])
        heat = np.interp(times, times[::15], random.uniform(0.0, 40.0, 20))
        ambient = np.interp(times, times[::30], random.uniform(5.0, 30.0, 10))
        y = lsim(system, np.column_stack([heat, ambient]), times, X0=[25.0, 22.0])[1].T
        y = [np.interp(times - late, times, each) for each in y]
        y = [each + 0.1 * random.normal(size=300) for each in y]
        given = (ce.Input("P", times, heat), ce.Input("T_ambient", times, ambient))
        seen = ce.Output("y_core", times, y[0], 0.1), ce.Output("y_case", times, y[1] + offset, 0.1)
        starts = (("T_core", 25.0), ("T_case", 22.0))
        runs.append(ce.Experiment(f"run {number}", 0.0, times[-1], given, seen, starts))
    path = FMU.with_name("thermal_two_node.fmu")
    solver = ce.Solver("dormand_prince")
    model = ce.Model(path.name, path.read_bytes(), "model_exchange", solver, tuple(WARM))
    parameters = [ce.Parameter(n, 1.2 * v, (v / 3.0, 3.0 * v)) for n, v in WARM.items()]
    return ce.Problem(model, parameters, runs)


WRONG = {
    "y": ({"position": 1000.0}, "mm instead of m", 1e-3),
    "F": ({"force": 1.0 / 9.80665, "known": ("m",)}, "kgf instead of N", 9.80665),
    "times": ({"time": 1.0 / 60.0, "known": ("m",)}, "min instead of s", 60.0),
}


def others_slow(names, *fast):
    """All names, of which all but a few are tests that take longer."""
    return [n if n in fast else pytest.param(n, marks=pytest.mark.slow) for n in names]


@pytest.mark.parametrize("name", others_slow(WRONG, "y"))
def test_a_unit_that_is_wrong_in_all_records_is_named(name):
    changes, unit, factor = WRONG[name]
    found = ce.fit(springs(**changes), resources=ONE)
    (fault,) = found.record_faults
    assert (fault.kind, fault.experiment, fault.variables) == ("unit", "", (name,))
    assert fault.unit == unit
    assert fault.factor == pytest.approx(factor)
    assert fault.before > 2.0
    assert max(fault.after, fault.held_out) < 1.3
    assert found.notes[0].startswith("check the records first")
    assert f"{unit}, in all experiments" in found.notes[0]
    assert f"factor = {factor:.6g} }}" in found.notes[0]


HEALTHY = {
    "a gain that is no conversion": {"position": 1.37},
    "a gain near a conversion": {"position": 900.0},
    "a factor that a parameter could have": {"force": 1.0 / 9.80665},
    "times that parameters could have": {"time": 1.0 / 60.0, "begin": 0.0},
    "a factor that another column may have": {"position": 1000.0, "known": ("m",), "begin": 0.0},
    "held-out records that are right": {"position": 1000.0, "right": (3,)},
    "one training record that is right": {"position": 1000.0, "right": (0,)},
}  # fmt: skip


@pytest.mark.parametrize(
    "why", others_slow(HEALTHY, "a gain near a conversion", "a factor that another column may have")
)
def test_no_unit_of_all_records_is_named_with(why):
    found = ce.fit(springs(**HEALTHY[why]), resources=ONE)
    assert found.rmse("train") > 2.0
    assert not [fault for fault in found.record_faults if not fault.experiment]


def test_a_thermometer_in_kelvins_is_named_with_its_offset():
    (fault,) = ce.fit(rooms(offset=273.15), resources=ONE).record_faults
    assert (fault.kind, fault.variables) == ("unit", ("y_case",))
    assert "K instead of degC" in fault.sentence
    assert "(or an offset of 273.1" in fault.sentence
    assert (fault.factor, fault.offset) == (1.0, -273.15)
    assert not ce.fit(rooms(offset=100.0), resources=ONE).record_faults


def test_a_late_clock_of_all_records_is_named():
    (fault,) = ce.fit(rooms(late=60.0), resources=ONE).record_faults
    assert (fault.kind, fault.experiment) == ("clock", "")
    assert fault.size == pytest.approx(60.0, abs=3.0)
    assert "a dead time of all inputs that the model lacks" in fault.sentence


def test_a_loop_says_it_first_and_looks_for_no_effect():
    found = ce.close_loop(springs(position=1000.0), resources=ONE)
    assert found.verdict == "unexplained"
    assert found.message.startswith("check the records first: output y")
    assert not found.effects


@pytest.mark.slow
def test_right_records_have_no_fault():
    found = ce.fit(springs(), resources=ONE)
    assert not found.record_faults
