import base64
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.integrate import solve_ivp
from support.drawn import DrawnFigure, Figures
from support.problems.springs import spring_problem
from support.reported import Page

from cluster_est import Output, Solver, fit, save
from cluster_est.html_report.number_text import digits
from cluster_est.html_report.page import write_report

SMALL = 1_500_000
"""Bytes of a report that is sent by mail without a thought."""


@pytest.fixture(scope="module")
def figures(run) -> Figures:
    return Figures(write_report(run))


@pytest.fixture(scope="module")
def errors(run):
    return pq.read_table(run / "errors.parquet").to_pandas()


def panel(figures: Figures, experiment: str) -> DrawnFigure:
    (found,) = [p for p in figures.panels if p.attributes["data-experiment"] == experiment]
    return found


def test_curves_are_those_of_the_tables(run, figures):
    table = pq.read_table(run / "residuals.parquet").to_pandas()
    shown = [(p.attributes["data-experiment"], p.attributes["data-output"]) for p in figures.panels]
    assert shown == list(dict.fromkeys(zip(table.experiment, table.output, strict=True)))
    assert ["held out" in " ".join(p.texts) for p in figures.panels] == [False, False, True]
    own = table[table.experiment == "e1"]
    _, curves, rest = panel(figures, "e1").plots
    for plot, name, expected in (
        (curves, "measured", own.measured),
        (rest, "after", own.measured - own.simulated),
    ):
        time, values = plot.curve(name)
        at = [int(np.abs(own.time - t).argmin()) for t in time]
        assert len(set(at)) == len(own)
        assert values == pytest.approx(expected.to_numpy()[at], abs=plot.grain(plot.y))


def test_between_measured_times_the_simulated_curves_are_those_of_the_trajectories(run, figures):
    fine = pq.read_table(run / "trajectories.parquet").to_pandas()
    own = fine[fine.experiment == "e0"]
    plot = panel(figures, "e0").plots[1]
    for name, column in (("after", "simulated"), ("before", "simulated_before")):
        time, values = plot.curve(name)
        expected = np.interp(time, own.time, own[column])
        assert values == pytest.approx(expected, abs=2e-3 * np.ptp(own[column]))


def test_the_curves_before_have_the_error_before(run, errors):
    table = pq.read_table(run / "residuals.parquet").to_pandas()
    for row in errors.to_dict("records"):
        own = table[(table.experiment == row["experiment"]) & (table.output == row["output"])]
        for column, when in (("simulated_before", "before"), ("simulated", "after")):
            found = math.sqrt(((own.measured - own[column]) ** 2).mean())
            assert found == pytest.approx(row[f"rmse_{when}"], rel=1e-9)
    fine = pq.read_table(run / "trajectories.parquet")
    assert fine["simulated_before"].null_count == 0


def test_runs_of_versions_without_curves_before_have_a_report(copied):
    for name in ("residuals", "trajectories"):
        table = pq.read_table(copied / f"{name}.parquet").drop_columns(["simulated_before"])
        table = table.replace_schema_metadata(None)  # they had no checksums either
        pq.write_table(table, copied / f"{name}.parquet")
    for plot in Figures(write_report(copied)).panels[0].plots[1:]:
        assert "before" not in plot.paths
        assert "after" in plot.paths


def test_a_report_of_a_fit_is_small(run):
    assert write_report(run).stat().st_size < 300_000


def put_long_experiments(folder: Path, count: int, samples: int) -> list[float]:
    """Into the tables of a run, each with one spike; when it is."""
    times, generator = np.arange(samples) * 0.01, np.random.default_rng(0)
    tables, spikes = [], []
    for number in range(count):
        measured = np.sin(times) + 0.1 * generator.normal(size=len(times))
        spike = int(generator.integers(len(times)))
        measured[spike] = 50.0
        spikes.append(float(times[spike]))
        columns = {"experiment": f"run{number}", "role": "train", "output": "y"}
        columns = {name: np.full(len(times), text) for name, text in columns.items()}
        columns |= {"time": times, "measured": measured, "residual": measured - np.sin(times)}
        columns |= {"simulated": np.sin(times), "simulated_before": np.cos(times)}
        tables.append(pa.table(columns))
    pq.write_table(pa.concat_tables(tables), folder / "residuals.parquet")
    return spikes


def test_many_long_experiments_stay_small_and_keep_their_peaks(copied):
    spikes = put_long_experiments(copied, 20, 10_000)
    path = write_report(copied)
    assert path.stat().st_size < SMALL
    figures = Figures(path)
    assert len(figures.panels) == 20
    for number, spike in enumerate(spikes):
        for plot in panel(figures, f"run{number}").plots:
            time, values = plot.curve("measured" if "measured" in plot.paths else "after")
            assert values.max() == pytest.approx(50.0, abs=1.1)
            assert time[values.argmax()] == pytest.approx(spike, abs=plot.grain(plot.x))
    assert "no peak is lost" in Page(path).text


def test_of_more_charts_than_a_page_can_hold_those_with_the_largest_errors_are_drawn(
    copied, errors
):
    put_long_experiments(copied, 252, 10)
    (row, *_) = errors.to_dict("records")
    sizes = np.random.default_rng(1).permutation(252) + 1.0
    rows = [row | {"experiment": f"run{i}", "normalised_after": s} for i, s in enumerate(sizes)]
    pq.write_table(pa.Table.from_pylist(rows), copied / "errors.parquet")
    path = write_report(copied)
    smallest = {f"run{i}" for i in np.argsort(sizes)[:2]}
    drawn = {p.attributes["data-experiment"] for p in Figures(path).panels}
    assert drawn == {f"run{i}" for i in range(252)} - smallest
    assert "Of 252 charts, the 250 with the largest errors are drawn." in Page(path).text


@pytest.mark.parametrize(
    ("seconds", "unit"),
    [(0.05, "ms"), (10.0, "s"), (300.0, "s"), (3600.0, "min"), (9e4, "h"), (3e6, "days")],
)
def test_time_is_in_the_unit_in_which_one_thinks_of_it(copied, seconds, unit):
    slow = copied
    for name in ("residuals", "trajectories"):
        table = pq.read_table(slow / f"{name}.parquet").to_pandas()
        table["time"] *= seconds / table.time.max()
        pq.write_table(pa.Table.from_pandas(table), slow / f"{name}.parquet")
    assert f"time ({unit})" in Figures(write_report(slow)).panels[0].texts


def test_the_first_picture_has_before_after_and_noise(run, figures, errors):
    figure = figures.by_id("before-and-after")
    assert {"noise", "before", "after", "e0", "e1", "e2 (held out)"} <= set(figure.texts)
    (plot,) = figure.plots
    noise = json.loads((run / "run.json").read_text())["residuals"]["outputs"][0]
    divisor = 1.0 if noise["declared"] else noise["noise_over_sigma"]
    for name in ("before", "after"):
        sizes, rows = plot.by_row(name, 3)
        assert rows == [0, 1, 2]
        expected = errors[f"normalised_{name}"].to_numpy() / divisor
        assert sizes == pytest.approx(expected, rel=2e-3)


def test_it_opens_on_the_worst_training_record_and_the_held_out_one(figures, errors):
    train = errors[errors.role == "train"]
    worst = train.loc[train.normalised_after.idxmax()]
    (test,) = errors[errors.role == "test"].to_dict("records")
    for name, title, row in (
        ("worst", "The worst training record", worst),
        ("held-out", "The held-out record", test),
    ):
        figure = figures.by_id(name)
        assert figure.texts[0].startswith(f"{title}: {row['experiment']}, y; error ")
        assert digits(row["rmse_after"], 3) in figure.texts[0]
        shown = [plot.paths for plot in panel(figures, row["experiment"]).plots]
        assert [plot.paths for plot in figure.plots] == shown


def test_the_input_stands_above_the_output(run, figures):
    table = pq.read_table(run / "inputs.parquet").to_pandas()
    own = table[(table.experiment == "e1") & (table.input == "F")]
    plot = panel(figures, "e1").plots[0]
    time, values = plot.curve("F")
    expected = np.interp(time, own.time, own.value)
    assert values == pytest.approx(expected, abs=0.02 * np.ptp(own.value))
    assert len(time) > 40


def test_residuals_have_a_scale_of_their_own_with_lines_at_twice_the_noise(figures, errors):
    """The error before is many times larger, and would make a straight line of what is left."""
    for experiment in ("e0", "e2"):
        rest = panel(figures, experiment).plots[-1]
        assert set(rest.paths) == {"after"}
        _, left = rest.curve("after")
        low, high = map(float, rest.y.split())
        (row,) = errors[errors.experiment == experiment].to_dict("records")
        assert row["rmse_before"] > 2.0 * row["rmse_after"]
        assert high - low < 1.5 * max(np.ptp(left), 4.0 * row["rmse_after"])


def unpacked(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """The records that are whole in a page, with the time of each sample."""
    found = {}
    for each in Page(path).of("data"):
        names = (each["data-curves"] or "").split()
        numbers = np.frombuffer(base64.b64decode(each["value"] or ""), "<f4").astype(float)
        curves = dict(zip(names, numbers.reshape(len(names), -1), strict=True))
        count, step = len(curves["measured"]), float(each["data-step"] or 0.0)
        steps = curves.pop("step") if not step else np.append(0.0, np.full(count - 1, step))
        curves["time"] = float(each["data-begin"] or 0.0) + np.cumsum(steps)
        found[each["data-name"] or ""] = curves
    return found


def test_a_long_record_is_whole_in_the_page_for_who_zooms_in(copied):
    put_long_experiments(copied, 2, 10_000)
    table = pq.read_table(copied / "residuals.parquet").to_pandas()
    kept = np.random.default_rng(2).random(len(table)) > 0.1 * (table.experiment == "run1")
    pq.write_table(pa.Table.from_pandas(table[kept]), copied / "residuals.parquet")
    path = write_report(copied)
    assert "the charts of all long records show every sample" in Page(path).text
    found = unpacked(path)
    for name in ("run0", "run1"):
        own = table[kept & (table.experiment == name)]
        curves = found[f"{name} y"]
        for curve, column in (
            ("measured", "measured"), ("after", "simulated"), ("before", "simulated_before"),
        ):  # fmt: skip
            assert curves[curve] == pytest.approx(own[column].to_numpy(), rel=1e-6, abs=1e-6)
        assert curves["time"] == pytest.approx(own.time.to_numpy(), abs=1e-5)


def test_of_more_samples_than_a_page_may_hold_it_says_where_they_are(copied):
    put_long_experiments(copied, 20, 10_000)
    path = write_report(copied)
    held = unpacked(path)
    assert 0 < len(held) < 20
    assert all(len(curves["time"]) == 10_000 for curves in held.values())
    text = Page(path).text
    assert f"the charts of {len(held)} of the 20 long records show every sample" in text
    assert "residuals.parquet in the run's folder has all samples" in text


@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation"])
def test_residuals_are_drawn_over_a_state_that_nobody_has_measured(tmp_path, interface):
    solver = Solver("fmu", step=0.01) if interface == "co_simulation" else None
    problem = spring_problem(2, local=(), interface=interface, solver=solver).problem
    times = problem.experiments[0].outputs[0].times

    def hardening(t, y, force):  # the model's spring is linear
        pull = np.interp(t, times, force)
        return y[1], (pull - 30.0 * y[0] - 4000.0 * y[0] ** 3 - 0.6 * y[1]) / 1.2

    runs = []
    for each in problem.experiments:
        found = solve_ivp(hardening, (0.0, times[-1]), (0.0, 0.0), "LSODA", times,
                          args=(each.inputs[0].values,), rtol=1e-8, atol=1e-10)  # fmt: skip
        runs.append(replace(each, outputs=(Output("v", times, found.y[1]),)))
    known = tuple(p for p in problem.parameters if p.name != "x0")
    model = replace(problem.model, parameters=tuple(p.target for p in known))
    result = fit(replace(problem, model=model, parameters=known, experiments=tuple(runs)))
    states = result.table("states").to_pandas()
    rows = states[states.experiment == "e0"].pivot(index="time", columns="state", values="value")
    simulated = result.table("residuals").to_pandas().query("experiment == 'e0'").simulated
    assert rows["v"].to_numpy() == pytest.approx(simulated.to_numpy(), abs=1e-9)
    moved = np.cumsum(0.5 * np.diff(rows.index) * (rows["v"].to_numpy()[1:] + rows["v"][:-1]))
    assert np.abs(rows["x"].to_numpy()[1:] - moved).max() < 0.02 * np.ptp(rows["x"])
    page = Page(write_report(save(result, tmp_path / "run")))
    assert "Over state x" in page.text
    assert "Over state v" not in page.text  # it is the output
