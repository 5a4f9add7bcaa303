"""The spring with hysteresis: both estimations of the reference tool's example, at most as long.

The reference tool's figures: without constraints the cost falls from 3.52665 to 0.000202507 in 104
function counts; with tolerances both are satisfied at its end, after 211.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.problems.seen_springs import values_of
from support.problems.springs import ROOT
from support.run_folders import rows

from cluster_est.cli import main

CONFIGS = ROOT / "configs"
FREE, TOLERANCES = (CONFIGS / f"wen_bouc_spring{end}.toml" for end in ("", "_tolerances"))
DROP = 0.000202507 / 3.52665
COUNTS, COUNTS_WITH_TOLERANCES = 104, 211
MEASURED = np.loadtxt(CONFIGS / "data" / "wen_bouc_spring.csv", delimiter=",", skiprows=1)
START = {"Amp": 1.0, "k_w": 150.0, "k_x": 280.0, "rho": 1.0, "sigma": 2.0, "W_0": 0.0}
BOUNDS = {"Amp": (0.94, 1.06), "W_0": (-1.0, 1.0)}
HEADER = ["iteration", "F-count", "f(x)", "max constraint", "step", "optimality"]


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


def search_of(folder: Path) -> list[dict[str, Any]]:
    return [row for row in rows(folder, "searches") if row["search"] == "train"]


def checked_estimates(folder: Path) -> dict[str, float]:
    """What was found, within its bounds."""
    assert {row["label"]: row["start"] for row in rows(folder, "parameters")} == START
    values = values_of(folder)
    for name, value in values.items():
        low, high = BOUNDS.get(name, (0.0, np.inf))
        assert low <= value <= high
    return values


def check_printed(folder: Path, capsys: pytest.CaptureFixture[str], *, bounded: bool) -> None:
    """Whether the iteration table says what the run's tables do, if `bounded` of violations too."""
    capsys.readouterr()
    assert main(["show", str(folder), "--iterations"]) == 0
    header, *lines = [line for line in capsys.readouterr().out.splitlines() if line]
    columns = [header.index(title) for title in HEADER]
    assert header.split() == " ".join(HEADER).split()
    search = search_of(folder)
    for line, row in zip(lines, search, strict=True):
        ends = [*columns[1:], None]
        cells = [line[a:b].strip() for a, b in zip(columns, ends, strict=True)]
        assert cells[0] == (row["ending"] or str(row["iteration"]))
        assert cells[1] == str(row["evaluations"])
        assert float(cells[2]) == pytest.approx(row["cost"], rel=1e-5)
        assert cells[3] == "" or float(cells[3]) == pytest.approx(row["violation"], rel=1e-5)
        assert bool(cells[3]) == bounded
    assert lines[0].split()[0] == "0"
    assert lines[-1].split()[0] == "converged"
    counts = [row["evaluations"] for row in search]
    assert counts == sorted(counts)


@pytest.mark.slow
def test_without_constraints_the_cost_falls_as_far_in_no_more_evaluations(tmp_path, capsys):
    assert main(["fit", str(FREE), "--out", str(tmp_path), "--no-report"]) == 0
    search = search_of(tmp_path)
    start = search[0]["cost"]
    assert start == pytest.approx(cost(START), rel=1e-6)
    reached = [row["evaluations"] for row in search if row["cost"] <= DROP * start]
    assert reached[0] <= COUNTS
    assert search[-1]["cost"] == pytest.approx(cost(checked_estimates(tmp_path)), rel=1e-4)
    falling = [row["cost"] for row in search]
    assert falling == sorted(falling, reverse=True)
    check_printed(tmp_path, capsys, bounded=False)


@pytest.mark.parametrize(
    "changes",
    [
        [],
        pytest.param(["method.options.speculative_gradient=true"], marks=pytest.mark.slow),
        pytest.param(["method.name=least_squares"], marks=pytest.mark.slow),
    ],
    ids=["sqp", "speculative", "least squares"],
)
@pytest.mark.slow
def test_with_tolerances_both_are_satisfied_in_no_more_evaluations(changes, tmp_path, capsys):
    assert main(["fit", str(TOLERANCES), "--out", str(tmp_path), "--no-report", *changes]) == 0
    assert "violated" not in capsys.readouterr().out
    search = search_of(tmp_path)
    satisfied = [row["evaluations"] for row in search if row["violation"] == 0.0]
    # of SQP to its end, not to the first point that satisfies them
    assert (satisfied[0] if changes else search[-1]["evaluations"]) <= COUNTS_WITH_TOLERANCES
    assert search[-1]["violation"] == 0.0
    assert search[-1]["cost"] <= DROP * search[0]["cost"]
    values, tolerances = checked_estimates(tmp_path), np.array([0.06, 20.0])
    known = rows(tmp_path, "constraints")
    names = [row["constraint"] for row in known]
    assert names == ["tolerance of Displacement [loops]", "tolerance of Force [loops]"]
    before, after = (np.array([row[key] for row in known]) for key in ("before", "after"))
    np.testing.assert_allclose(before, farthest(START) / tolerances - 1.0, rtol=1e-6)
    np.testing.assert_allclose(after, farthest(values) / tolerances - 1.0, rtol=1e-4)
    assert before.max() > 0.0 >= after.max()
    check_printed(tmp_path, capsys, bounded=True)
