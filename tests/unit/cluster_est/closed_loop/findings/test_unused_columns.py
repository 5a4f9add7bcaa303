from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest
from support.loop_objects import made_fitter, made_problem
from support.truth.stacked_noise import coloured, late

from cluster_est import LoopSettings
from cluster_est.closed_loop.findings.unexplained import varying_columns
from cluster_est.problem.tables.sources import TableSource

SAMPLES, RUNS = 600, 2
LEVEL = LoopSettings().significance


def drawn(rng, a=0.98):
    """A series for each experiment."""
    return [coloured(rng, SAMPLES, a) for _ in range(RUNS)]


def fitter(folder, **columns):
    """A fitter whose experiments are from files with these columns: a series of a run each."""
    problem = made_problem(*[SAMPLES] * RUNS)
    sources = []
    for e in range(RUNS):
        path = folder / f"run{e}.csv"
        time = np.linspace(0.0, 1.0, SAMPLES)
        table = {"t": time, "y": np.zeros(SAMPLES)} | {n: own[e] for n, own in columns.items()}
        pacsv.write_csv(pa.table(table), path)
        sources.append(TableSource(f"run {e}", path, "t", None, None, ("t", "y")))
    return made_fitter(replace(problem, tables=tuple(sources)))


def test_a_disturbance_that_was_logged_is_named(tmp_path):
    rng = np.random.default_rng(1)
    suns = drawn(rng)
    others = {f"other{i}": drawn(rng) for i in range(4)}
    made = fitter(tmp_path, Sonne_Wm2=[800.0 + 50.0 * sun for sun in suns], **others)
    residuals = np.concatenate([late(sun, 8.0) for sun in suns])
    residuals += 0.2 * np.random.default_rng(2).standard_normal(len(residuals))
    (found,) = varying_columns(made, residuals, LEVEL)
    assert (found.column, found.output) == ("Sonne_Wm2", "y0")
    assert found.p < 1e-4
    assert found.share > 0.7
    said = "the unused column 'Sonne_Wm2' explains"
    assert found.sentence.startswith(said)


@pytest.mark.slow
def test_columns_that_have_nothing_to_do_with_it_are_hardly_ever_named(tmp_path):
    """10 draws with 6 columns each, at 1 % for all of them together."""
    rng = np.random.default_rng(11)
    named = 0
    for draw in range(10):
        folder = tmp_path / str(draw)
        folder.mkdir()
        columns = {f"c{i}": drawn(rng, 0.97) for i in range(6)}
        residuals = np.concatenate(drawn(rng, 0.97))
        named += bool(varying_columns(fitter(folder, **columns), residuals, LEVEL))
    assert named <= 1


def test_a_copy_of_what_is_used_is_not_named(tmp_path):
    outputs = drawn(np.random.default_rng(3))
    copies = [1000.0 * own + 3.0 for own in outputs]
    made = fitter(tmp_path, again=copies, n=[np.arange(SAMPLES)] * RUNS)
    runs = tuple(
        replace(run, outputs=(replace(run.outputs[0], values=own),))
        for run, own in zip(made.problem.experiments, outputs, strict=True)
    )
    problem = replace(made.problem, experiments=runs)
    made = replace(made, problem=problem)
    assert varying_columns(made, np.concatenate(outputs), LEVEL) == ()


def test_a_wave_of_the_same_period_is_named_as_that_and_no_more(tmp_path):
    rng = np.random.default_rng(4)
    wave = np.sin(2.0 * np.pi * 5.0 * np.linspace(0.0, 1.0, SAMPLES))
    noise = [rng.standard_normal(SAMPLES) for _ in range(RUNS)]
    made = fitter(tmp_path, daily=[20.0 + 3.0 * wave] * RUNS, noise=noise)
    residuals = np.tile(wave, RUNS) + 0.1 * rng.standard_normal(RUNS * SAMPLES)
    (found,) = varying_columns(made, residuals, LEVEL, period=0.2)
    assert found.column == "daily"
    assert np.isnan(found.p)
    said = (
        "the unused column 'daily' has the same period as the residual, 0.2 s: try the column as "
    )
    assert found.sentence == f"{said}data of the input F, or as a signal"
    assert replace(found, silent=()).sentence == f"{said}a signal"
    assert varying_columns(made, residuals, LEVEL, period=0.13) == ()


@pytest.mark.parametrize("spoil", ["gone", "text", "short"])
def test_a_file_that_has_changed_says_nothing(tmp_path, spoil):
    rng = np.random.default_rng(5)
    series = drawn(rng)
    made = fitter(tmp_path, c=series)
    residuals = np.concatenate(series) + 0.1 * rng.standard_normal(RUNS * SAMPLES)
    assert [c.column for c in varying_columns(made, residuals, LEVEL)] == ["c"]
    path = tmp_path / "run1.csv"
    if spoil == "gone":
        path.unlink()
    elif spoil == "text":
        path.write_text("t,y,c\n0,0,a\n1,0,b\n")
    else:
        path.write_text("t,y,c\n0,0,1\n0.1,0,2\n0.2,0,1\n")
    assert varying_columns(made, residuals, LEVEL) == ()


def test_experiments_without_files_have_no_columns():
    made = made_fitter(made_problem(SAMPLES))
    assert varying_columns(made, np.random.default_rng(0).standard_normal(SAMPLES), LEVEL) == ()
