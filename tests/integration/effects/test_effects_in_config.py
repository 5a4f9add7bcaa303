import json
import re
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.problems.springs import FMU
from support.truth.springs_with_effects import FORCE, TIMES, C, K, M, pushed, solve

from cluster_est.cli import main

CONFIG = """
[model]
fmu = {fmu}

[parameters]
m = {{ start = 1.0, bounds = [0.1, 10.0] }}
k = {{ start = 25.0, bounds = [1.0, 100.0] }}
c = {{ start = 0.8, bounds = [0.0, 10.0] }}

[[effects]]
{effect}

[[experiments]]
id = "run"
data = "run.csv"
time = "t"
inputs = {{ F = "force" }}
outputs = {{ y = "position" }}
values = {{ x = 0.1 }}
"""
FRICTION = """
name = "friction"
site = "der(v)"
form = "coulomb"
parameters = { k = { start = 0.1, unit = "m/s2" }, width = { start = 0.01, fixed = true } }
"""
OWN = """
name = "friction"
site = "der(v)"
equation = "-k * tanh(v / 0.01)"
parameters = { k = { start = 0.1, neutral = 0.0 } }
"""
SAYS_NOTHING = OWN.replace(", neutral = 0.0", "")
SAYS_WHAT_IS_NOT_SO = OWN.replace("start = 0.1, neutral = 0.0", "start = 0.2, neutral = 0.2")
OF_TWO = """
name = "friction"
site = "der(v)"
equation = "-k * tanh(v / 0.01) - b * v^3"
parameters = { k = { start = 0.1 }, b = { start = 0.0, neutral = 0.0, fixed = true } }
"""
OWN_PAIR = """
name = "friction"
site = "pair x,v"
equation = "0"
reaction = "-k * tanh(v / 0.01)"
parameters = { k = { start = 0.1, neutral = 0.0 } }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With what was measured of the springs with the friction."""
    made = tmp_path_factory.mktemp("friction")
    measured = solve(pushed(lambda t, x, f: -0.5 * np.tanh(x[1] / 0.01)))[:, 0]
    columns = np.column_stack([TIMES, FORCE, measured])
    np.savetxt(made / "run.csv", columns, "%.17g", ",", header="t,force,position", comments="")
    return made


def fitted(folder, effect, *overrides):
    """The exit code of a fit with an effect, and its run folder."""
    config, out = folder / "config.toml", folder / "run"
    config.write_text(CONFIG.format(fmu=json.dumps(str(FMU)), effect=effect))
    shutil.rmtree(out, ignore_errors=True)
    return main(["fit", str(config), "--out", str(out), "--no-report", *overrides]), out


@pytest.mark.parametrize(
    ("effect", "equation"),
    [
        (FRICTION, "der(v) += -k * tanh(v / width)"),
        (OWN, "der(v) += -k * tanh(v / 0.01)"),
        (SAYS_NOTHING, "der(v) += -k * tanh(v / 0.01)"),
        (SAYS_WHAT_IS_NOT_SO, "der(v) += -k * tanh(v / 0.01)"),
        (OF_TWO, "der(v) += -k * tanh(v / 0.01) - b * v^3"),
        (OWN_PAIR, "der(x) += 0, der(v) += -k * tanh(v / 0.01)"),
    ],
    ids=["form", "equation", "no neutral", "no such neutral", "of two", "pair"],
)
def test_a_named_effect_is_fitted_and_written_down(folder, capsys, effect, equation):
    code, out = fitted(folder, effect)
    assert code == 0
    rows = pq.read_table(out / "parameters.parquet").to_pylist()
    found = {row["label"]: row["value"] for row in rows if row["estimated_on"] == "train"}
    assert found == pytest.approx({"m": M, "k": K, "c": C, "friction.k": 0.5}, rel=1e-5)
    assert main(["export", str(out), "--text"]) == 0
    assert equation in " ".join(capsys.readouterr().out.split())


def test_an_equation_that_does_nothing_is_left_out_of_an_export(folder, capsys):
    code, out = fitted(folder, OWN.replace("start = 0.1", "start = 0.0, fixed = true"))
    assert code == 0
    assert main(["export", str(out), "--text"]) == 0
    shown = "".join(capsys.readouterr())
    assert "'friction' is left out, because it has no influence" in shown


def test_an_effect_may_have_coefficients_of_each_experiment(folder):
    own = FRICTION.replace("start = 0.1,", 'start = 0.1, per = "experiment",')
    code, out = fitted(folder, own)
    assert code == 0
    rows = pq.read_table(out / "parameters.parquet").to_pylist()
    found = {row["label"]: row["value"] for row in rows}
    assert found["friction.k[run]"] == pytest.approx(0.5, rel=1e-5)
    assert "could not be computed" not in (out / "run.json").read_text(encoding="utf-8")


@pytest.mark.parametrize("executor", ["processes", pytest.param("ray", marks=pytest.mark.slow)])
def test_effects_elsewhere_have_the_same_bits(folder, executor):
    tables = []
    for name in ("local", executor):
        code, out = fitted(folder, FRICTION, f"executor.name={name}", "executor.workers=2")
        assert code == 0
        tables.append((out / "parameters.parquet").read_bytes())
    assert tables[0] == tables[1]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"der(v)"', '"der(w)"', r"has no site der\(w\)"),
        ('"coulomb"', '"colomb"', "did you mean 'coulomb'"),
        ('site = "der(v)"', 'place = "der(v)"', "unknown key effects"),
        ("width =", "widht =", "no such coefficient.*did you mean 'width'"),
        (", width = { start = 0.01, fixed = true }", "", r"parameters\.width\.start is missing"),
        ('form = "coulomb"', "", "exactly one of form and equation.*neither"),
        ('form = "coulomb"', 'form = "coulomb"\nequation = "k"', "form and equation.*both"),
        ("start = 0.1", "start = -0.1", r'"friction\.k"\.start: must lie within the bounds'),
    ],
)
def test_a_wrong_effect_is_one_sentence(folder, capsys, old, new, said):
    code, out = fitted(folder, FRICTION.replace(old, new))
    assert code == 2
    error = " ".join(capsys.readouterr().err.split())
    assert re.search(said, error)
    assert "Traceback" not in error
    assert not out.exists()
