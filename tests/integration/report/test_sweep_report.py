import re
import shutil
from urllib.parse import unquote

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.drawn import Figures
from support.reported import HOSTILE, Page
from support.run_folders import change_facts, facts, rows
from support.truth.springs_with_friction import write_config

from cluster_est.cli import main

RUNS = (("a", 3.0, 2.5, 1.0), ("b", 1.1, 1.4, 2.0), ("c", 1.0, 9.0, 2.5))
"""Method, training error, held-out error and estimate of k."""


def row(method, train, test, k):
    found = {"run": f"spring-{method}", "config": "spring", "method": method, "status": "done"}
    found |= {"message": "converged", "doubts": "", "cost_before": 9.0, "cost": 1.0}
    found |= {"rmse_train": train, "rmse_test": test, "iterations": 5, "evaluations": 20}
    return found | {"simulations": 60, "failures": 0, "seconds": 75.0, "parameter k": k}


def failed(method, why):
    whole = dict.fromkeys(row("", 0.0, 0.0, 0.0))
    return whole | {"run": f"spring-{method}", "config": "spring", "method": method,
                    "status": "failed", "message": why}  # fmt: skip


def written(folder, rows):
    folder.mkdir()
    pq.write_table(pa.Table.from_pylist(rows), folder / "summary.parquet")
    return folder


@pytest.fixture
def sweep(tmp_path):
    return written(tmp_path / "results", [*(row(*each) for each in RUNS), failed("d", HOSTILE)])


def page_of(sweep):
    assert main(["report", str(sweep)]) == 0
    return sweep / "report.html"


def test_it_says_how_many_runs_ended_well_and_which_are_best(sweep, capsys):
    page = Page(page_of(sweep))
    assert capsys.readouterr().out == f"report: {sweep / 'report.html'}\n"
    assert "Best of 4 runs: spring-b: error 1.10 over sigma, held out 1.40" in page.text
    assert "3 of 4 runs reached a solution" in page.text
    assert "Of the others: 1 failed." in page.text
    assert "1 min 15 s" in page.text


def test_a_command_for_a_run_says_that_it_was_given_a_sweep(sweep, capsys):
    assert main(["show", str(sweep)]) == 2
    assert "the folder of a sweep: choose the folder of one of its runs" in capsys.readouterr().err


def test_its_pictures_show_the_errors_and_the_estimates_of_every_run(sweep):
    figures = Figures(page_of(sweep))
    errors, estimates = figures.by_id("errors-of-runs"), figures.by_id("estimates-0")
    for figure, name, column in (
        (errors, "training", 1),
        (errors, "held out", 2),
        (estimates, "k", 3),
    ):
        (plot,) = figure.plots
        values, place = plot.by_row(name, 3)
        best_first = [each[column] for each in sorted(RUNS, key=lambda each: each[2])]
        assert values == pytest.approx([best_first[i] for i in place], rel=2e-3)
        assert sorted(place) == [0, 1, 2]


NARROW = "its intervals are too narrow, because the error of y is 4.6 times sigma"


@pytest.mark.parametrize(
    ("doubts", "said", "tone"),
    [
        (["", ""], "2 of 2 runs reached a solution.", "good"),
        ([NARROW, ""], "2 of 2 runs reached a solution; 1 of these is doubtful", "good"),
        (["", NARROW], "2 of 2 runs reached a solution; 1 of these is doubtful", ""),
        ([NARROW, NARROW], "2 of 2 runs reached a solution; all of these are doubtful", ""),
    ],
)
def test_it_is_as_green_as_its_best_run_and_each_run_as_its_own_report(
    tmp_path, doubts, said, tone
):
    """The second one is the best."""
    runs = [row(*each) | {"doubts": own} for each, own in zip(RUNS, doubts, strict=False)]
    page = Page(page_of(written(tmp_path / "results", runs)))
    assert said in page.text
    assert [attributes.get("class") for attributes in page.of("h1")] == [tone]
    assert page.text.count("4.6 times sigma") == doubts.count(NARROW)
    assert sum(cell.get("class") == "good" for cell in page.of("td")) == 2 - doubts.count(NARROW)


def test_texts_of_its_table_are_escaped_and_nothing_is_fetched(sweep):
    page = Page(page_of(sweep))
    assert HOSTILE in page.text
    assert not page.of("img")
    assert not page.of("b")
    assert not page.of("link")
    assert len(page.of("script")) == 1
    assert not [a for tag, a in page.elements if "src" in a]


def test_a_sweep_in_which_nothing_has_run_yet_has_a_page_too(tmp_path):
    sweep = written(tmp_path / "results", [failed("a", "stopped"), failed("b", "stopped")])
    page = Page(page_of(sweep))
    assert "0 of 2 runs reached a solution" in page.text
    ids = [attributes["id"] for attributes in page.of("section") if "id" in attributes]
    assert ids == ["runs"]


def test_a_summary_that_is_damaged_is_said_in_a_sentence(sweep, capsys):
    (sweep / "summary.parquet").write_bytes(b"PAR1 not really")
    assert main(["report", str(sweep)]) == 2
    error = capsys.readouterr().err
    assert "damaged" in error
    assert error.count("\n") == 1


SWEEP = """
configs = ["config.toml"]
study = "{study}"
[overrides]
"executor.workers" = 1
{overrides}
[[axes]]
name = "data"
[axes.values]
all = {{}}
one = {{ drop_experiments = ["run1"] }}
"""


def swept(folder, study, overrides="", out="results", **options):
    """A sweep of the springs with friction, with all of them and without one."""
    write_config(folder, **options)
    (folder / "sweep.toml").write_text(SWEEP.format(study=study, overrides=overrides))
    assert main(["sweep", str(folder / "sweep.toml"), "--out", str(folder / out)]) in (0, 1)
    return folder / out


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    return swept(tmp_path_factory.mktemp("fits"), "fit")


def test_estimates_have_their_intervals_and_units(fits):
    page = page_of(fits)
    figures = Figures(page)
    runs = [fits / "config-all", fits / "config-one"]
    for number, label in enumerate("mkc"):
        figure = figures.by_id(f"estimates-{number}")
        found = [{r["label"]: r for r in rows(run, "parameters")}[label] for run in runs]
        assert f"{label} ({found[0]['unit']})" in figure.texts
        (plot,) = figure.plots
        ends, places = plot.by_row("95 % interval", 2)
        known = {(r["lower95"], r["upper95"]) for r in found}
        shown = {tuple(ends[[i for i, p in enumerate(places) if p == place]]) for place in (0, 1)}
        for each, expected in zip(sorted(shown), sorted(known), strict=True):
            assert each == pytest.approx(expected, abs=2.0 * plot.grain(plot.x))


def test_its_best_run_is_poor_and_nothing_is_green(fits):
    page = Page(page_of(fits))
    assert [attributes.get("class") for attributes in page.of("h1")] == [""]
    assert "Fitted, but doubtful: error 0.00" in page.text
    assert "times the noise" in page.text
    assert not [cell for cell in page.of("td") if "good" in (cell.get("class") or "")]


def test_it_links_to_a_report_of_each_run_wherever_it_stands(fits, tmp_path):
    for page in (page_of(fits), tmp_path / "elsewhere.html"):
        assert main(["report", str(fits), "--out", str(page)]) == 0
        links = {a["href"] for a in Page(page).of("a") if not a["href"].startswith("#")}
        assert len(links) == 2
        for link in links:
            linked = page.parent / unquote(link)
            assert linked.name == "report.html"
            assert "Fitted, but doubtful" in Page(linked).text


def test_parameters_left_out_are_in_the_report_of_the_best_run(fits, monkeypatch):
    monkeypatch.setattr("cluster_est.html_report.first_screen.MOST_PARAMETERS", 1)
    text = Page(page_of(fits)).text
    assert "more: see the report of the best run." in text
    assert "see Parameters" not in text  # a sweep has no such section


def test_what_to_do_next_is_that_of_the_best_run(fits):
    said = Page(page_of(fits)).text.partition("What next")[2]
    best = Page(page_of(fits)).text.partition("Best of 2 runs: ")[2].partition(".")[0]
    run = fits / best
    assert f"cluster-est close-loop {run}/config.toml --out {run}-loop" in said


def other_data(run, name):
    """Give a run another held-out experiment, or the same one with other samples."""
    keys = facts(run)["experiments"]
    change_facts(run, experiments=keys | {"run2": f"{keys['run2']} {name}"})


def test_only_runs_on_the_same_data_are_compared(fits, tmp_path):
    """Two runs on each of two sets of data, and one alone on a third."""
    sweep = tmp_path / "results"
    table = pq.read_table(fits / "summary.parquet").to_pylist()
    listed = []
    for config, of in (("a", 0), ("a", 1), ("b", 0), ("b", 1), ("c", 0)):
        run = f"{config}-{of}"
        shutil.copytree(fits / table[of]["run"], sweep / run)
        other_data(sweep / run, config)
        listed.append(table[of] | {"run": run, "config": config})
    pq.write_table(pa.Table.from_pylist(listed), sweep / "summary.parquet")
    text = Page(page_of(sweep)).text
    assert "5 of 5 runs reached a solution, on 3 different sets of data" in text
    assert "Best of" not in text
    assert "Runs on different data are not compared with each other." in text
    assert len(re.findall(r"The best of 2 runs on the same data is [ab]-[01]\.", text)) == 2
    assert len(re.findall(r"The 2 runs with [ab] (dis)?agree", text)) == 2
    assert "The runs agree" not in text
    assert "Errors of the runs, by their data" in text
    figure = Figures(sweep / "report.html").by_id("errors-of-runs")
    assert {each["run"] for each in listed} <= {*figure.texts}  # not "all" and "one" twice
    assert "The report of the best run" not in text


def test_estimates_of_different_models_need_not_agree(fits, tmp_path):
    sweep = tmp_path / "results"
    shutil.copytree(fits, sweep)
    fmu = facts(sweep / "config-one")["fmu"]
    change_facts(sweep / "config-one", fmu=fmu | {"sha256": "another"})
    text = Page(page_of(sweep)).text
    assert "Best of 2 runs: config-" in text  # their errors on the same data are comparable
    assert "agree" not in text


def test_small_differences_look_small(tmp_path):
    """Of errors, whose axis begins at 0, and of estimates without intervals."""
    sweep = written(tmp_path / "results", [row("a", 1.1, 1.2, 2.0), row("b", 1.1001, 1.21, 2.0004)])
    figures = Figures(page_of(sweep))
    for name, least in (("errors-of-runs", 1.2), ("estimates-0", 0.2)):
        (plot,) = figures.by_id(name).plots
        low, high = map(float, plot.x.split())
        assert high - low >= least


def test_a_sweep_that_is_called_again_shows_what_has_changed_since(tmp_path):
    """The same files twice are one time; other data are a second one, in this folder or another."""
    for _ in range(2):
        folder = swept(tmp_path, "fit", out="monday")
    assert "History" not in Page(page_of(folder)).text
    swept(tmp_path, "fit", out="monday", friction=0.05)
    times = pq.read_table(folder / "history.parquet").to_pandas()
    assert [*times.run] == ["config-all", "config-one"] * 2
    page = page_of(folder)
    before, now = times.rmse_test[times.run == "config-one"]
    assert now < 0.5 * before
    told = re.search(r"config-one 2 \S+ data \S+ → \S+ (\S+) → (\S+)", Page(page).text)
    assert told
    assert [*map(float, told.groups())] == pytest.approx([before, now], rel=0.01)
    (plot,) = Figures(page).by_id("history-0").plots  # what changed most
    assert sorted(plot.curve("held out")[1]) == pytest.approx(sorted([before, now]), rel=1e-2)
    page = page_of(swept(tmp_path, "fit", out="tuesday", friction=0.05))
    assert "config-all 3" in Page(page).text


@pytest.mark.slow
def test_a_sweep_of_closed_loops_says_what_its_best_run_has_found(tmp_path):
    page = Page(page_of(swept(tmp_path, "close-loop", '"closed_loop.max_effects" = 1')))
    assert "Best of 2 runs: config-" in page.text
    assert "Found: Coulomb friction at der(v)" in page.text
    assert page.text.count("coulomb_v") >= 3  # among the estimates, and in the row of each run
