import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.drawn import Figures
from support.reported import HOSTILE, Page

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
    assert "3 of 4 runs reached a solution" in page.text
    assert "Of the others: 1 failed." in page.text
    assert "The least held-out error, 1.40 over sigma, is that of spring-b." in page.text
    assert "The least training error, 1.00 over sigma, is that of spring-c." in page.text
    assert "1 min 15 s" in page.text


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


NARROW = "its intervals are too narrow; the error of y is 4.6 times sigma"


@pytest.mark.parametrize(
    ("doubts", "title", "tone"),
    [
        (["", ""], "2 of 2 runs reached a solution", "good"),
        (["", NARROW], "2 of 2 runs reached a solution; 1 of these is doubtful", ""),
        ([NARROW, NARROW], "2 of 2 runs reached a solution; all of these are doubtful", ""),
    ],
)
def test_a_run_is_as_green_as_its_own_report(tmp_path, doubts, title, tone):
    rows = [row(*each) | {"doubts": said} for each, said in zip(RUNS, doubts, strict=False)]
    page = Page(page_of(written(tmp_path / "results", rows)))
    assert title in page.text
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
