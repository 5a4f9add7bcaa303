import re

import numpy as np
import pytest
from support.problems.springs import FMU, TRUE
from support.truth.exact_linear import position

import cluster_est as ce
from cluster_est import Resources
from cluster_est.preflight.all_checks import run_checks

TIMES = 0.02 * np.arange(500)
NOISE = 0.002
GAP = slice(200, 260)
CONFIG = f"""
[model]
fmu = "{FMU.as_posix()}"

[parameters]
m = {{ start = 1.0, bounds = [0.1, 10.0] }}
k = {{ start = 25.0, bounds = [1.0, 200.0] }}
c = {{ start = 0.8, bounds = [0.0, 10.0] }}

[[experiments]]
id = "run"
data = "run.csv"
time = "t"
inputs = {{ F = "F" }}
outputs = {{ y = "y" }}
sigma = {{ y = {NOISE} }}
"""


def write(folder, missing):
    """A record whose input steps in the gap, as a logger writes it that has lost something."""
    levels = np.random.default_rng(4).choice([-2.0, 1.0, 3.0], 25)
    force = np.repeat(levels, 20)
    y = position(TIMES, force, **TRUE, x0=0.0, v0=0.0)
    y = y + NOISE * np.random.default_rng(5).normal(size=len(TIMES))
    cells = {name: [repr(v) for v in values.tolist()] for name, values in
             (("t", TIMES), ("F", force), ("y", y))}  # fmt: skip
    for name in missing:
        cells[name][GAP] = [""] * 60
    rows = zip(*cells.values(), strict=True)
    lines = ["t,F,y", *(",".join(row) for row in rows if row[0])]
    (folder / "run.csv").write_text("\n".join(lines) + "\n")
    (folder / "config.toml").write_text(CONFIG)
    return folder / "config.toml"


@pytest.mark.parametrize(
    ("missing", "found"),
    [
        (
            "tFy",
            "no data at all: input F may have changed there, so a new part begins after the gap",
        ),
        (
            "Fy",
            "no data at all: input F may have changed there, so a new part begins after the gap",
        ),
        (
            "F",
            "no data for input F: input F may have changed there, so a new part begins after the "
            "gap",
        ),
        ("y", "no data for output y: the inputs are known in the gap"),
    ],
)
def test_a_gap_is_told_of_and_leads_no_estimate_astray(tmp_path, missing, found):
    problem = ce.read_problem(write(tmp_path, missing))
    page = run_checks(problem, Resources(executor="local"), 0.0)
    (check,) = [each for each in page.findings if each.check == "gaps"]
    said = rf"experiment run has a gap of 1\.2\d* s, from 3.98 to 5.2 s, with {found}"
    assert re.search(said, check.found)
    result = ce.fit(problem, resources=Resources(executor="local"))
    assert any(re.search(said, note) for note in result.notes)
    rows = {each.label: each for each in result.estimates}
    for name, true in TRUE.items():
        assert abs(rows[name].value - true) < 4.0 * rows[name].std_error
        assert rows[name].std_error < 0.01 * true
    assert result.rmse("train") == pytest.approx(1.0, abs=0.15)
    states = {label for label in rows if label.endswith("[run from 5.2 s]")}
    split = missing != "y"
    assert states == ({"x[run from 5.2 s]", "v[run from 5.2 s]"} if split else set())
