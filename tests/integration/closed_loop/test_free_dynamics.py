"""Dynamics of a shape that is not in the library are found as one filter; data by SciPy."""

import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import freqs, lfilter, lsim
from support.problems.springs import ROOT

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict

TRUE = {"C_core": 400.0, "C_case": 900.0, "R_core_case": 0.5, "R_case_ambient": 1.2}
GAIN, LAGS = 0.6 / 900.0, (60.0, 120.0, 200.0)
"""Of the power that reaches the case by way of three layers: in K / s for each W."""
NOISE = 0.05
TIMES = np.arange(0.0, 4000.0, 20.0)
START = (("T_core", 30.0), ("T_case", 28.0))


def powers(number):
    """A power that is switched, and held for some minutes."""
    random = np.random.default_rng([3, number])
    turns = np.cumsum(random.uniform(150.0, 600.0, 20))
    levels = random.uniform(0.0, 40.0, 21)
    return levels[np.searchsorted(turns, TIMES)]


def measured(number, disturbance=None):
    """An experiment with the hidden layers, or in their place a heat that nobody measured."""
    power = powers(number)

    def rates(t, x):
        core, case, *layers = x
        heat = np.interp(t, TIMES, power)
        across = (core - case) / TRUE["R_core_case"]
        lost = (case - 20.0) / TRUE["R_case_ambient"]
        more = GAIN * layers[-1] if disturbance is None else np.interp(t, TIMES, disturbance)
        before = [heat, *layers]
        filled = [(u - z) / tau for u, z, tau in zip(before, layers, LAGS, strict=False)]
        return [(heat - across) / TRUE["C_core"], (across - lost) / TRUE["C_case"] + more, *filled]

    starts = [*(value for _, value in START), *(power[0] for _ in LAGS)]
    span = (0.0, float(TIMES[-1]))
    truth = solve_ivp(rates, span, starts, t_eval=TIMES, rtol=1e-8, atol=1e-8, max_step=20.0).y
    random = np.random.default_rng([7, number])
    seen = tuple(
        ce.Output(output, TIMES, y + NOISE * random.normal(size=len(y)), NOISE)
        for output, y in zip(("y_core", "y_case"), truth[:2], strict=True)
    )
    given = (ce.Input("P", TIMES, power), ce.Input("T_ambient", TIMES, np.full(len(TIMES), 20.0)))
    role = "test" if number == 3 else "train"
    return ce.Experiment(f"run{number}", *span, given, seen, START, role=role)


def searched(runs, *forms, most=2):
    path = ROOT / "configs" / "models" / "thermal_two_node.fmu"
    solver = ce.Solver("dormand_prince")
    model = ce.Model(path.name, path.read_bytes(), "model_exchange", solver, tuple(TRUE))
    parameters = tuple(ce.Parameter(n, 1.2 * v, (v / 10.0, 10.0 * v)) for n, v in TRUE.items())
    settings = ce.LoopSettings(
        sites=("der(T_case)", "der(T_core)"), forms=forms, draws=200, max_effects=most
    )
    return ce.close_loop(ce.Problem(model, parameters, tuple(runs)), settings=settings)


@pytest.fixture(scope="module")
def found():
    return searched(map(measured, range(4)), *FORMS)


FORMS = ("hidden_dynamics", "hidden_exchange", "constant", "square")
"""No form that a filter of third order could be patched from."""


def drawn(number):
    """A slow heat that nobody measured, in K / s, another one in each experiment."""
    random = np.random.default_rng([11, number]).standard_normal(len(TIMES) + 50)
    slow = lfilter([1.0], [1.0, -1.8, 0.81], random)[50:]
    return 0.004 * slow / slow.std()


@pytest.mark.slow
def test_dynamics_of_no_known_form_are_found_at_their_place(found):
    assert found.verdict in (Verdict.FOUND, Verdict.PARTIAL)
    (effect,) = found.effects
    assert (effect.site, effect.variables) == ("der(T_case)", ("P",))
    assert effect.form in ("hidden_dynamics", "hidden_dynamics_5")
    assert found.rms("test", "before") > 5.0
    assert found.rms("test", "after") < 1.3


@pytest.mark.slow
def test_its_step_response_is_drawn_and_said(found, tmp_path):
    """Three lags in a row, by SciPy; the band of 95 % is not wider than a fifth of the gain."""
    curve, magnitude, phase = found.curves
    assert (curve.variable, curve.unit) == ("time after a step of P by 1", "degC/s")
    lags = np.diag([-1.0 / tau for tau in LAGS]) + np.diag([1.0 / tau for tau in LAGS[1:]], -1)
    system = (lags, [[1.0 / LAGS[0]], [0.0], [0.0]], [[0.0, 0.0, GAIN]], [[0.0]])
    _, truth, _ = lsim(system, np.ones(len(curve.x)), curve.x)
    np.testing.assert_allclose(curve.y, truth, atol=0.05 * GAIN)
    assert 0.0 < (curve.upper - curve.lower)[1:].max() < 0.2 * GAIN
    assert [each.unit for each in (magnitude, phase)] == ["dB", "deg"]
    slow = magnitude.x < 1.0 / sum(LAGS) / np.pi
    poles = -1.0 / np.array(LAGS)
    _, gain = freqs([-GAIN * poles.prod()], np.poly(poles), 2.0 * np.pi * magnitude.x[slow])
    np.testing.assert_allclose(magnitude.y[slow], 20.0 * np.log10(np.abs(gain)), atol=1.0)
    np.testing.assert_allclose(phase.y[slow], np.degrees(np.unwrap(np.angle(gain))), atol=6.0)
    (effect,) = found.effects
    done = curve.x[np.argmax(truth > (1.0 - np.exp(-1.0)) * GAIN)] / 60.0
    said = re.search(r"no known form: .* reaches 63 % after ([\d.]+) min", effect.sentence)
    assert float(said[1]) == pytest.approx(done, rel=0.1)
    assert "a place without a law" in effect.claim.sentence
    assert "hidden dynamics" in found.message
    ce.report(found, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "time after a step of P by 1 (s)" in text
    assert "der(T_case) (dB) over frequency of a sine in P (Hz)" in text


@pytest.mark.slow
def test_the_log_has_it_as_a_finding_of_its_own_move(found):
    rows = found.table("findings").to_pylist()
    accepted = [row for row in rows if row["stage"] == "accepted"]
    assert [(row["family"], row["freedom"]) for row in accepted] == [("hidden dynamics", 3)]
    kept = [row["move"] for row in found.table("structures").to_pylist() if row["accepted"]]
    assert "free dynamics" in kept


@pytest.mark.slow
def test_a_filter_takes_the_place_of_what_leaves_more_than_noise():
    """A decay passes first, and there is room for one effect."""
    forms = ("hidden_dynamics", "emptying")
    single = searched(map(measured, range(4)), *forms, most=1)
    (effect,) = single.effects
    assert (effect.site, effect.form) == ("der(T_case)", "hidden_dynamics")
    kept = [row for row in single.table("structures").to_pylist() if row["accepted"]]
    assert [row["move"] for row in kept] == ["add", "free dynamics"]
    rows = single.table("findings").to_pylist()
    assert "hidden_dynamics" in {row["form"] for row in rows if row["stage"] == "accepted"}
    assert single.rms("test", "after") < 1.3


@pytest.mark.slow
def test_no_dynamics_are_claimed_of_a_disturbance():
    found = searched([measured(number, drawn(number)) for number in range(4)], *FORMS)
    assert found.effects == ()
    assert found.verdict not in (Verdict.FOUND, Verdict.PARTIAL)
