"""A closed loop in co-simulation finds a parameter that follows what is measured; data by SciPy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.problems.springs import ROOT

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict

TRUE = {"C_core": 400.0, "C_case": 900.0, "R_core_case": 0.5, "R_case_ambient": 1.2}
FALLS, MEAN, NOISE = -0.012, 40.0, 0.1
"""Of the resistance to the surroundings with the temperature of the case, in 1/K; K; K."""
TIMES = np.arange(0.0, 3000.0, 20.0)
START = (("T_core", 30.0), ("T_case", 28.0))


def experiment(number: int, role: str, random: np.random.Generator) -> ce.Experiment:
    power = 20.0 + 10.0 * np.sin(2.0 * np.pi * TIMES / (700.0 + 150.0 * number) + number)
    power += 8.0 * np.sign(np.sin(2.0 * np.pi * TIMES / (1900.0 - 200.0 * number)))
    air = 20.0 + 5.0 * np.sin(2.0 * np.pi * TIMES / 2600.0 + number)

    def rates(t, x):
        out = TRUE["R_case_ambient"] * (1.0 + FALLS * (x[1] - MEAN))
        across = (x[0] - x[1]) / TRUE["R_core_case"]
        lost = (x[1] - np.interp(t, TIMES, air)) / out
        heat = np.interp(t, TIMES, power)
        return [(heat - across) / TRUE["C_core"], (across - lost) / TRUE["C_case"]]

    span, starts = (0.0, float(TIMES[-1])), [value for _, value in START]
    truth = solve_ivp(rates, span, starts, t_eval=TIMES, rtol=1e-9, atol=1e-9, max_step=20.0).y
    seen = tuple(
        ce.Output(name, TIMES, y + NOISE * random.normal(size=len(y)), NOISE)
        for name, y in zip(("y_core", "y_case"), truth, strict=True)
    )
    given = (ce.Input("P", TIMES, power), ce.Input("T_ambient", TIMES, air))
    return ce.Experiment(f"e{number}", *span, given, seen, START, role=role)


def test_a_resistance_that_falls_with_a_measured_temperature():
    path = ROOT / "configs" / "models" / "thermal_two_node.fmu"
    solver = ce.Solver("fmu", step=10.0)
    model = ce.Model(path.name, path.read_bytes(), "co_simulation", solver, tuple(TRUE))
    random = np.random.default_rng(1)
    roles = ("train", "train", "test")
    runs = tuple(experiment(n, role, random) for n, role in enumerate(roles))
    parameters = tuple(ce.Parameter(n, 1.2 * v, (v / 10.0, 10.0 * v)) for n, v in TRUE.items())
    settings = ce.LoopSettings(
        sites=("parameter R_case_ambient", "output y_case"),
        forms=("linear", "gain", "lag"),
        draws=200,
        max_effects=1,
        pairs=False,
    )
    found = ce.close_loop(ce.Problem(model, parameters, runs), settings=settings)
    assert found.verdict == Verdict.FOUND
    (effect,) = found.effects
    assert (effect.site, effect.form) == ("parameter R_case_ambient", "linear")
    assert effect.words in ("a variation linear in y_case", "a variation linear in y_core")
    slope = next(c.value for c in effect.coefficients if c.label.endswith(".k"))
    assert slope == pytest.approx(FALLS, rel=0.25)
