"""Columns that a config does not use: named where they vary with what is left, else not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest
from scipy.signal import lfilter
from support.loop_objects import made_bench, made_fit, made_problem

from cluster_est.closed_loop.account import _disturbance, _with_columns
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.residual.disturbance import unexplained_residuals
from cluster_est.closed_loop.findings.residual.unused_columns import varying_columns
from cluster_est.problem.tables.unused import TableSource

SAMPLES, RUNS = 600, 2


def coloured(rng, a):
    return lfilter([1.0], [1.0, -a], rng.standard_normal(SAMPLES + 400))[400:]


def late(x, lag):
    keep = np.exp(-1.0 / lag)
    return lfilter([1.0 - keep], [1.0, -keep], x)


def bench(folder, columns, rows=None):
    """A workbench whose experiments are from files with these columns: a function of a run each."""
    problem = made_problem(*[SAMPLES] * RUNS)
    sources = []
    for e in range(RUNS):
        path = folder / f"run{e}.csv"
        time = np.linspace(0.0, 1.0, SAMPLES)
        table = {"t": time, "y": np.zeros(SAMPLES)} | {n: c(e) for n, c in columns.items()}
        pacsv.write_csv(pa.table(table), path)
        sources.append(TableSource(f"run {e}", path, "t", None, rows, ("t", "y")))
    return made_bench(replace(problem, tables=tuple(sources)))


def test_a_disturbance_that_was_logged_is_named(tmp_path):
    rng = np.random.default_rng(1)
    suns = [coloured(rng, 0.98) for _ in range(RUNS)]
    others = [[coloured(rng, 0.98) for _ in range(RUNS)] for _ in range(4)]
    columns = {"Sonne_Wm2": lambda e: 800.0 + 50.0 * suns[e]}
    for i, other in enumerate(others):
        columns[f"other{i}"] = lambda e, other=other: other[e]
    made = bench(tmp_path, columns)
    residuals = np.concatenate([late(sun, 8.0) for sun in suns])
    residuals += 0.2 * np.random.default_rng(2).standard_normal(len(residuals))
    (found,) = varying_columns(made, residuals)
    assert (found.column, found.output) == ("Sonne_Wm2", "y0")
    assert found.p < 1e-4
    assert found.share > 0.7
    assert found.sentence.startswith(
        "column 'Sonne_Wm2' is not used and varies with it (it carries"
    )


def test_columns_that_have_nothing_to_do_with_it_are_hardly_ever_named(tmp_path):
    """20 draws with 6 columns each, at 1 % for all of them together."""
    rng = np.random.default_rng(11)
    named = 0
    for draw in range(20):
        folder = tmp_path / str(draw)
        folder.mkdir()
        series = [[coloured(rng, 0.97) for _ in range(RUNS)] for _ in range(6)]
        columns = {f"c{i}": (lambda e, own=own: own[e]) for i, own in enumerate(series)}
        residuals = np.concatenate([coloured(rng, 0.97) for _ in range(RUNS)])
        named += bool(varying_columns(bench(folder, columns), residuals))
    assert named <= 2


def test_a_copy_of_what_is_used_is_not_named(tmp_path):
    rng = np.random.default_rng(3)
    outputs = [coloured(rng, 0.98) for _ in range(RUNS)]
    made = bench(tmp_path, {"again": lambda e: 1000.0 * outputs[e] + 3.0, "n": lambda e: STEPS})
    runs = tuple(
        replace(run, outputs=(replace(run.outputs[0], values=own),))
        for run, own in zip(made.problem.experiments, outputs, strict=True)
    )
    made = replace(made, problem=replace(made.problem, experiments=runs))
    assert varying_columns(made, np.concatenate(outputs)) == ()


STEPS = np.arange(SAMPLES)


def test_a_wave_of_the_same_period_is_named_as_that_and_no_more(tmp_path):
    rng = np.random.default_rng(4)
    wave = np.sin(2.0 * np.pi * 5.0 * np.linspace(0.0, 1.0, SAMPLES))
    made = bench(
        tmp_path,
        {"daily": lambda e: 20.0 + 3.0 * wave, "noise": lambda e: rng.standard_normal(SAMPLES)},
    )
    residuals = np.tile(wave, RUNS) + 0.1 * rng.standard_normal(RUNS * SAMPLES)
    found = varying_columns(made, residuals, period=0.2)
    assert [c.column for c in found] == ["daily"]
    assert np.isnan(found[0].p)
    said = "column 'daily' is not used and has the same period, 0.2 s: try it as "
    assert found[0].sentence == f"{said}input F, which has no data, or as a signal"
    assert replace(found[0], silent=()).sentence == f"{said}a signal"
    assert varying_columns(made, residuals, period=0.13) == ()


@pytest.mark.parametrize("spoil", ["gone", "text", "short"])
def test_a_file_that_has_changed_says_nothing(tmp_path, spoil):
    rng = np.random.default_rng(5)
    series = [coloured(rng, 0.98) for _ in range(RUNS)]
    made = bench(tmp_path, {"c": lambda e: series[e]})
    residuals = np.concatenate(series) + 0.1 * rng.standard_normal(RUNS * SAMPLES)
    assert [c.column for c in varying_columns(made, residuals)] == ["c"]
    path = tmp_path / "run1.csv"
    if spoil == "gone":
        path.unlink()
    elif spoil == "text":
        path.write_text("t,y,c\n0,0,a\n1,0,b\n")
    else:
        path.write_text("t,y,c\n0,0,1\n0.1,0,2\n0.2,0,1\n")
    assert varying_columns(made, residuals) == ()


def test_experiments_without_files_have_no_columns():
    made = made_bench(made_problem(SAMPLES))
    assert varying_columns(made, np.random.default_rng(0).standard_normal(SAMPLES)) == ()


def test_a_summary_names_the_column_beside_what_nothing_explains(tmp_path):
    rng = np.random.default_rng(8)
    gusts = [coloured(rng, 0.98) for _ in range(RUNS)]
    made = bench(tmp_path, {"gust_N": lambda e: 3.0 * gusts[e]})
    residuals = 20.0 * np.concatenate([late(gust, 5.0) for gust in gusts])
    residuals += 0.5 * rng.standard_normal(len(residuals))
    fitted = made_fit(made.problem, residuals)
    left = unexplained_residuals(made, fitted, np.array([0.5]))
    found = _with_columns(made, fitted, left)
    assert [len(each.columns) for each in found] == [1]
    (_, said) = _disturbance(Verdict.UNEXPLAINED, found)
    assert said.startswith("column 'gust_N' is not used and varies with it")
    assert _disturbance(Verdict.PARTIAL, found) == ()
