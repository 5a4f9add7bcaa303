"""The spring with hysteresis: both estimations of the reference tool's example, at most as long.

The reference tool's figures: without constraints the cost falls from 3.52665 to 0.000202507 in 104
function counts; with tolerances both are satisfied at its end, after 211.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.integrate import solve_ivp
from support.problems.springs import ROOT

from cluster_est import Result, build_problem, fit, read_config
from cluster_est.cli import main
from cluster_est.methods import Method
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.methods.sqp.method import Sqp
from cluster_est.running.records import SearchIteration

CONFIGS = ROOT / "configs"
FREE, TOLERANCES = (CONFIGS / f"wen_bouc_spring{end}.toml" for end in ("", "_tolerances"))
DROP = 0.000202507 / 3.52665
COUNTS, COUNTS_WITH_TOLERANCES = 104, 211
MEASURED = np.loadtxt(CONFIGS / "data" / "wen_bouc_spring.csv", delimiter=",", skiprows=1)
START = {"Amp": 1.0, "k_w": 150.0, "k_x": 280.0, "rho": 1.0, "sigma": 2.0, "W_0": 0.0}
BOUNDS = {"Amp": (0.94, 1.06), "W_0": (-1.0, 1.0)}
HEADER = ["iteration", "F-count", "f(x)", "max constraint", "step", "optimality"]

Rows = list[dict[str, Any]]


def curve(values: dict[str, float]) -> np.ndarray:
    """(points, 2): displacement and force, simulated by SciPy with n = 1.5 and omega = 1."""
    amplitude, k_w, k_x, rho, sigma, start = values.values()

    def rate(t: float, w: np.ndarray) -> np.ndarray:
        v, power = amplitude * np.cos(t), np.abs(w) ** 0.5 * w
        return rho * (v - sigma * abs(v) * power + (sigma - 1.0) * v * np.abs(power))

    times = np.linspace(0.0, 18.85, 1886)
    found = solve_ivp(rate, (0.0, 18.85), [start], "LSODA", times, rtol=1e-10, atol=1e-12)
    x = amplitude * np.sin(times)
    return np.stack([x, k_x * x + k_w * found.y[0]], axis=1)


def offsets(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(points, 2): from the nearest place of the segment from a to b to each point."""
    place = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return points - a - place[:, None] * (b - a)


def cost(values: dict[str, float]) -> float:
    """Of squares of the distance of each measured segment to the nearest simulated point."""
    scale = np.abs(MEASURED).max(axis=0)
    points = curve(values) / scale
    pairs = pairwise(MEASURED / scale)
    return float(sum((offsets(points, a, b) ** 2).sum(axis=1).min() for a, b in pairs))


def farthest(values: dict[str, float]) -> np.ndarray:
    """How far any simulated point lies from its nearest segment, in each column."""
    points = curve(values)
    all_offsets = np.array([offsets(points, a, b) for a, b in pairwise(MEASURED)])
    nearest = (all_offsets**2).sum(axis=2).argmin(axis=0)
    return np.abs(all_offsets[nearest, np.arange(len(points))]).max(axis=0)


def check_estimates(values: dict[str, float]) -> None:
    assert list(values) == list(START)
    for name, value in values.items():
        low, high = BOUNDS.get(name, (0.0, np.inf))
        assert low <= value <= high


def table(folder: Path, name: str) -> Rows:
    return pq.read_table(folder / f"{name}.parquet").to_pylist()


def printed(folder: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    assert main(["show", str(folder), "--iterations"]) == 0
    return [line for line in capsys.readouterr().out.splitlines() if line]


@pytest.fixture(scope="module")
def free_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wen_bouc") / "run"
    assert main(["fit", str(FREE), "--out", str(folder)]) == 0
    return folder


def test_without_constraints_the_cost_falls_as_far_in_no_more_evaluations(free_run):
    rows = [row for row in table(free_run, "searches") if row["search"] == "train"]
    start = rows[0]["cost"]
    assert start == pytest.approx(cost(START), rel=1e-6)
    assert {row["label"]: row["start"] for row in table(free_run, "parameters")} == START
    reached = [row["evaluations"] for row in rows if row["cost"] <= DROP * start]
    assert reached[0] <= COUNTS
    values = {row["label"]: row["value"] for row in table(free_run, "parameters")}
    check_estimates(values)
    assert rows[-1]["cost"] == pytest.approx(cost(values), rel=1e-4)


def test_the_iteration_table(free_run, capsys):
    header, *lines = printed(free_run, capsys)
    columns = [header.index(title) for title in HEADER]
    assert columns == sorted(columns)
    assert header.split() == " ".join(HEADER).split()
    rows = [row for row in table(free_run, "searches") if row["search"] == "train"]
    assert len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        ends = [*columns[1:], None]
        cells = [line[a:b].strip() for a, b in zip(columns, ends, strict=True)]
        assert cells[0] == (row["ending"] or str(row["iteration"]))
        assert cells[1] == str(row["evaluations"])
        assert float(cells[2]) == pytest.approx(row["cost"], rel=1e-5)
        assert cells[3] == ""  # there are no constraints
    assert lines[0].split()[0] == "0"
    assert lines[-1].split()[0] == "converged"
    counts = [row["evaluations"] for row in rows]
    assert counts == sorted(counts)
    falling = [row["cost"] for row in rows]
    assert falling == sorted(falling, reverse=True)


def fitted(method: Method) -> tuple[Result, list[SearchIteration]]:
    """With tolerances, from a config that a later or earlier version of the methods can read."""
    config = read_config(TOLERANCES, ["method.name=least_squares"])
    lines: list[SearchIteration] = []
    return fit(build_problem(config, CONFIGS), method, note=lines.append), lines


@pytest.mark.parametrize(
    "method", [Sqp(), Sqp(speculative_gradient=True), LeastSquares()], ids=repr
)
def test_with_tolerances_both_are_satisfied_in_no_more_evaluations(method):
    result, lines = fitted(method)
    assert result.success
    last = lines[-1]
    assert last.progress.violation == 0.0
    assert last.progress.ending == "converged"
    first = next(line for line in lines if line.progress.violation == 0.0)
    assert first.evaluations <= COUNTS_WITH_TOLERANCES
    names = [row.constraint for row in result.constraints]
    assert names == ["tolerance of Displacement [loops]", "tolerance of Force [loops]"]
    before, after = (np.array([getattr(row, key) for row in result.constraints])
                     for key in ("before", "after"))  # fmt: skip
    tolerances = np.array([0.06, 20.0])
    np.testing.assert_allclose(before, farthest(START) / tolerances - 1.0, rtol=1e-6)
    np.testing.assert_allclose(after, farthest(result.x) / tolerances - 1.0, rtol=1e-4)
    assert (before > 0.0).any()
    assert (after <= 0.0).all()
    assert all(row.satisfied for row in result.constraints)
    check_estimates(result.x)
    assert result.cost <= DROP * result.cost_before


def test_the_search_with_tolerances_ends_in_no_more_evaluations():
    """To its end, not to the first point that satisfies them."""
    _, lines = fitted(Sqp())
    assert lines[-1].evaluations <= COUNTS_WITH_TOLERANCES


def test_with_tolerances_by_the_command_line(tmp_path, capsys):
    folder = tmp_path / "run"
    assert main(["fit", str(TOLERANCES), "--out", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "tolerance of Displacement [loops]" in said
    assert "violated" not in said
    header, *lines = printed(folder, capsys)
    first, second = (header.index(title) for title in ("max constraint", "step"))
    violations = [float(line[first:second]) for line in lines]
    assert violations[0] == pytest.approx(farthest(START)[0] / 0.06 - 1.0, rel=1e-4)
    assert violations[-1] == 0.0
    rows = [row for row in table(folder, "searches") if row["search"] == "train"]
    satisfied = [row["evaluations"] for row in rows if row["violation"] == 0.0]
    assert satisfied[0] <= COUNTS_WITH_TOLERANCES
