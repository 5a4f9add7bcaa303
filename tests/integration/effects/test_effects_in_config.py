"""Effects that a config names: from the file to the tables, and what it must not say."""

from __future__ import annotations

import json

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
OWN_PAIR = """
name = "friction"
site = "pair x,v"
equation = "0"
reaction = "-k * tanh(v / 0.01)"
parameters = { k = { start = 0.1, neutral = 0.0 } }
"""


@pytest.fixture
def write(tmp_path):
    def config(effect):
        measured = solve(pushed(lambda t, x, f: -0.5 * np.tanh(x[1] / 0.01)))[:, 0]
        rows = zip(TIMES, FORCE, measured, strict=True)
        lines = ["t,force,position", *(",".join(repr(float(v)) for v in row) for row in rows)]
        (tmp_path / "run.csv").write_text("\n".join(lines))
        path = tmp_path / "config.toml"
        path.write_text(CONFIG.format(fmu=json.dumps(str(FMU)), effect=effect))
        return str(path)

    return config


@pytest.mark.parametrize("effect", [FRICTION, OWN, OWN_PAIR])
def test_a_named_effect_is_fitted(write, tmp_path, effect):
    assert main(["fit", write(effect), "--out", str(tmp_path / "run")]) == 0
    rows = pq.read_table(tmp_path / "run" / "parameters.parquet").to_pylist()
    found = {row["label"]: row["value"] for row in rows if row["estimated_on"] == "train"}
    assert found == pytest.approx({"m": M, "k": K, "c": C, "friction.k": 0.5}, rel=1e-5)


def test_effects_run_on_ray_with_the_same_bits(write, tmp_path):
    config = write(FRICTION)
    tables = []
    for executor in ("local", "ray"):
        out = tmp_path / executor
        overrides = [f"executor.name={executor}", "executor.workers=2"]
        assert main(["fit", config, "--out", str(out), *overrides]) == 0
        tables.append((out / "parameters.parquet").read_bytes())
    assert tables[0] == tables[1]


@pytest.mark.parametrize(
    ("old", "new", "phrase"),
    [
        ('"der(v)"', '"der(w)"', "no such site der(w)"),
        ('"coulomb"', '"colomb"', "did you mean 'coulomb'?"),
        ('site = "der(v)"', 'place = "der(v)"', "unknown key effects"),
        ("width =", "widht =", "has no such coefficient; did you mean 'width'?"),
        (", width = { start = 0.01, fixed = true }", "", "parameters.width.start is missing"),
        ('form = "coulomb"', "", "must have either form or equation but has neither"),
        ('form = "coulomb"', 'form = "coulomb"\nequation = "k"', "but has both"),
        ("start = 0.1", "start = -0.1", "friction.k.start: must lie in its bounds"),
    ],
)
def test_a_wrong_effect_is_one_sentence(write, tmp_path, capsys, old, new, phrase):
    assert main(["fit", write(FRICTION.replace(old, new)), "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert phrase in said
    assert "Traceback" not in said
    assert not (tmp_path / "run").exists()
