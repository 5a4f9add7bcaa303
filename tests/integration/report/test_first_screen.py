import json
import re
import shutil
from math import nan

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.drawn import Figures
from support.reported import Page
from support.run_folders import change_facts, facts, rows

from cluster_est.cli import main
from cluster_est.html_report.number_text import digits, percent
from cluster_est.html_report.page import write_report
from cluster_est.studies.save_report_export import NO_CONFIG


@pytest.fixture(scope="module")
def page(run) -> Page:
    return Page(write_report(run))


def headline(page: Page) -> str:
    """What stands between the name of the run and the first table."""
    return page.text.partition("parameter value ±")[0]


def test_it_says_how_well_in_the_unit_of_the_output_and_over_the_noise(run, page):
    errors = rows(run, "errors")
    noise = facts(run)["residuals"]["outputs"][0]["noise_over_sigma"]
    for role, before in (("train", "error"), ("test", "held out")):
        own = [row for row in errors if row["role"] == role]
        rmse, over = (
            np.sqrt(
                np.average([row[name] ** 2 for row in own], weights=[r["samples"] for r in own])
            )
            for name in ("rmse_after", "normalised_after")
        )
        said = f"{before} {digits(rmse, 3)} {own[0]['unit']}, {digits(over / noise, 3)} times"
        assert said in headline(page)


def test_each_parameter_has_its_share_of_uncertainty_and_what_the_fmu_calls_it(run, page):
    for row in rows(run, "parameters"):
        if row["scope"] != "shared":
            continue
        half = 0.5 * (row["upper95"] - row["lower95"])
        share = percent(half / row["value"], 2).replace("\u2009", " ")
        name = " ".join(filter(None, (row["label"], row["description"])))
        found = re.search(rf"{re.escape(name)} (\S+) {re.escape(digits(half, 2))} "
                          rf"{re.escape(share)} {re.escape(row['unit'])}", page.text)  # fmt: skip
        assert found, row["label"]
        assert float(found[1]) == pytest.approx(row["value"], abs=0.05 * half)


@pytest.mark.parametrize(
    ("doubts", "tone", "verdict"),
    [
        ([], "good", "Fitted to the noise: error"),
        (["a record looks wrong"], "", "Fitted, but doubt"),
    ],
)
def test_doubts_take_the_green_and_follow_the_headline(copied, doubts, tone, verdict):
    change_facts(copied, doubts=doubts)
    page = Page(write_report(copied))
    assert page.of("h1") == [{"class": tone}]
    assert verdict in headline(page)
    assert ("A record looks wrong." in headline(page)) is bool(doubts)


@pytest.mark.parametrize(
    ("change", "step"),
    [
        ({"doubts": []}, "cluster-est export {run} --fmu fitted.fmu"),
        (
            {"residuals": {"too_narrow": True, "outputs": []}},
            "cluster-est close-loop {run}/config.toml --out {run}-loop",
        ),
        ({"status": "not converged"}, "a larger budget"),
    ],
)
def test_it_says_what_to_do_next_with_commands_to_paste(copied, capsys, change, step):
    change_facts(copied, **change)
    step = step.format(run=copied)
    said = Page(write_report(copied)).text.partition("What next")[2].partition("The worst")[0]
    assert step in said
    assert main(["show", str(copied)]) == 0
    assert step in capsys.readouterr().out


def test_commands_in_the_terminal_name_the_folder_as_it_was_given(copied, capsys, monkeypatch):
    change_facts(copied, doubts=[])
    monkeypatch.chdir(copied.parent)
    folder = copied.rename(copied.parent / "my run")
    assert main(["show", "my run", "--json"]) == 0
    steps = json.loads(capsys.readouterr().out)["next"]
    assert {"text": "Export the fitted model.",
            "command": "cluster-est export 'my run' --fmu fitted.fmu"} in steps  # fmt: skip
    monkeypatch.chdir(folder)
    change_facts(folder, residuals={"too_narrow": True, "outputs": []})
    assert main(["show", "."]) == 0
    assert f"close-loop config.toml --out '{folder}-loop'" in capsys.readouterr().out


def test_a_run_saved_from_python_has_no_config_for_a_command(copied):
    (copied / "config.toml").write_text(NO_CONFIG)
    change_facts(copied, residuals={"too_narrow": True, "outputs": []})
    text = Page(write_report(copied)).text
    assert "See what the model lacks." in text
    assert "cluster-est close-loop" not in text


def test_parameters_that_are_not_determined_or_at_a_bound_have_no_uncertainty(copied):
    table = pq.read_table(copied / "parameters.parquet").to_pylist()
    table[0] |= {"at_bound": "upper"}
    table[1] |= {"lower95": nan, "upper95": nan}
    pq.write_table(pa.Table.from_pylist(table), copied / "parameters.parquet")
    text = Page(write_report(copied)).text
    assert "at its upper bound" in text
    assert "not determined" in text
    assert f"Widen the bounds of {table[0]['label']}" in text


def changed_residuals(path, change):
    """Put other simulated values into a run, from what was measured and the time."""
    table = pq.read_table(path / "residuals.parquet").to_pandas()
    table["simulated"] = table.measured - change(table)
    pq.write_table(pa.Table.from_pandas(table), path / "residuals.parquet")
    return table


def test_the_autocorrelation_is_that_of_the_residuals(copied):
    generator = np.random.default_rng(0)
    table = changed_residuals(copied, lambda t: np.convolve(generator.normal(size=len(t)),
                                                            np.ones(6), "same"))  # fmt: skip
    table = table[table.role == "train"]
    parts = [(own.measured - own.simulated).to_numpy() for _, own in table.groupby("experiment")]
    step = float(np.diff(table.time[table.experiment == "e0"]).mean())
    figure = Figures(write_report(copied)).by_id("residual-0-lags")
    (plot,) = figure.plots
    lags, rho = plot.curve("autocorrelation")
    squares = sum(float(part @ part) for part in parts)
    for lag, value in zip(np.rint(lags / step).astype(int), rho, strict=True):
        expected = sum(float(part[:-lag] @ part[lag:]) for part in parts) / squares
        assert value == pytest.approx(expected, abs=plot.grain(plot.y))
    limit = 1.96 / np.sqrt(sum(map(len, parts)))
    outside = float(np.mean(np.abs(rho) > limit))
    assert f"{percent(outside)} of {len(rho)} lags" in figure.texts[0]


def test_residuals_bend_over_what_is_missing(copied):
    """Here it is the square of the output; over the time there is nothing."""
    noise = np.random.default_rng(1)
    changed_residuals(copied, lambda t: t.measured**2 + 1e-3 * noise.normal(size=len(t)))
    figures = Figures(write_report(copied))
    titles = {each.texts[0]: each for each in figures.found if each.texts}
    (plot,) = titles["Over simulated y"].plots
    across, mean = plot.curve("mean")
    middle = mean[np.argmin(np.abs(across))]
    assert mean[0] > 3.0 * middle + 0.01
    assert mean[-1] > 3.0 * middle + 0.01
    assert {"Over time", "Over rate of y", "Over input F"} <= set(titles)


def test_a_run_without_inputs_in_its_folder_has_a_report_too(copied):
    """One of an earlier version."""
    shutil.rmtree(copied / "evaluations")
    (copied / "inputs.parquet").unlink()
    figures = Figures(write_report(copied))
    assert len(figures.by_id("worst").plots) == 2
