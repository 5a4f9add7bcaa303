import base64
import hashlib
import re
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.cut_logs import cut
from support.drawn import Figures
from support.reported import HOSTILE, Page
from support.run_folders import change_facts, facts, leave_as_killed
from support.truth.springs_with_friction import write_config

from cluster_est.cli import main
from cluster_est.html_report.page import write_report


@pytest.fixture(scope="module")
def page(run) -> Page:
    return Page(write_report(run))


def sections(page: Page) -> list[str]:
    return [attributes["id"] for attributes in page.of("section") if "id" in attributes]


def change(path: Path, table: str, column: str, value: object, row: int = 0) -> None:
    """Put something else into a cell of a table."""
    rows = pq.read_table(path / f"{table}.parquet").to_pylist()
    rows[row][column] = value
    pq.write_table(pa.Table.from_pylist(rows), path / f"{table}.parquet")


def test_the_verdict_comes_first_and_what_follows_is_in_order(page):
    order = ["Fitted to the noise: error 0.0", "parameter values of", "The error fell from",
             "± (95 %)", "over noise", "What next", "The worst training record: e",
             "The held-out record: e2", "What to know", "Correlations", "Error before and after",
             "Before: start values.", "Autocorrelation", "The search ended: converged. The cost",
             "simulations, none failed"]  # fmt: skip
    places = [page.text.index(each) for each in order]
    assert places == sorted(places)
    assert sections(page) == [
        "parameters",
        "errors",
        "curves",
        "residuals",
        "search",
        "workers",
        "provenance",
    ]


def test_the_same_folder_gives_the_same_page(run, tmp_path):
    first = write_report(run, tmp_path / "a.html").read_bytes()
    assert write_report(run, tmp_path / "b.html").read_bytes() == first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.html", "b.html"]


def test_only_its_own_scripts_may_run_and_nothing_is_fetched(run, page):
    (policy,) = [
        attributes["content"]
        for attributes in page.of("meta")
        if attributes.get("http-equiv") == "Content-Security-Policy"
    ]
    allowed = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert allowed["default-src"] == "'none'"
    assert not re.search(r"https?:|\*|unsafe-eval", policy)
    (running,) = [text for attributes, text in page.scripts if "type" not in attributes]
    digest = base64.b64encode(hashlib.sha256(running.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in allowed["script-src"]
    assert "'unsafe-inline'" not in allowed["script-src"]
    assert not page.of("link")
    assert not page.of("iframe")
    assert not [a for tag, a in page.elements if "src" in a]
    text = (run / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|//[a-z]|@import|url\(", text)


def test_values_from_files_are_escaped_wherever_they_come_from(copied):
    for table, column in (
        ("errors", "output"), ("errors", "unit"), ("errors", "experiment"), ("residuals", "unit"),
        ("parameters", "label"), ("parameters", "unit"), ("searches", "search"),
        ("correlations", "label"), ("workers", "worker"),
    ):  # fmt: skip
        change(copied, table, column, HOSTILE)
    table = pq.read_table(copied / "residuals.parquet").to_pandas()
    table["experiment"] = HOSTILE + table["experiment"]
    table["output"] = HOSTILE + table["output"]
    pq.write_table(pa.Table.from_pandas(table), copied / "residuals.parquet")
    fmu = facts(copied)["fmu"] | {"name": HOSTILE}
    said = {"message": HOSTILE, "notes": [HOSTILE], "versions": {HOSTILE: HOSTILE}}
    change_facts(copied, fmu=fmu, **said)
    page = Page(write_report(copied))
    assert not page.of("img")
    assert not page.of("b")
    assert len(page.of("script")) == 1
    assert not [a for tag, a in page.elements if any(name.startswith("on") for name in a)]
    assert page.text.count(HOSTILE) >= 8
    panels = Figures(copied / "report.html").panels
    assert {each.attributes["data-experiment"] for each in panels} == {
        HOSTILE + f"e{i}" for i in range(3)
    }


def test_a_run_that_goes_on_says_so_and_loads_itself_again(copied):
    leave_as_killed(copied)
    cut(copied / "evaluations", 20, torn=100)
    page = Page(write_report(copied, reload=7.0))
    assert page.of("body") == [{"data-reload": "7.0"}]
    assert "The run is in progress" in page.text
    assert "every 7 s" in page.text
    assert sections(page) == ["search", "workers", "provenance"]
    assert page.of("body") != Page(write_report(copied)).of("body")


def test_an_interrupted_run_shows_what_is_there(copied):
    for path in [*copied.glob("*.parquet"), copied / "progress.jsonl", copied / "config.toml"]:
        path.unlink()
    shutil.rmtree(copied / "evaluations")
    (copied / "run.json").write_text('{"status": "interrupted", "message": "interrupted; early"}')
    text = Page(write_report(copied)).text
    assert "The run was interrupted" in text
    assert "The run left no results" in text


def test_what_is_no_run_or_damaged_is_said_in_a_sentence(copied, tmp_path, capsys):
    (copied / "parameters.parquet").write_bytes(b"PAR1 not really")
    for folder, said in ((tmp_path / "nothing", "has no run.json"), (copied, "damaged")):
        assert main(["report", str(folder)]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1


def test_a_fit_writes_its_report_and_ends_as_it_would_without(tmp_path, capsys):
    report = tmp_path / "run" / "report.html"
    config = str(write_config(tmp_path, roles=("train",)))
    run = ["fit", config, "--overwrite", "--out", str(report.parent)]
    assert main([*run, "--no-report"]) == 0
    assert not report.exists()
    assert main(run) == 0
    assert report.is_file()
    assert f"report: {report}" in capsys.readouterr().out
    report.unlink()
    report.mkdir()
    assert main(run) == 0
    assert "the report could not be written" in capsys.readouterr().err


def test_a_report_goes_where_it_is_told(run, tmp_path, capsys):
    out = tmp_path / "other.html"
    assert main(["report", str(run), "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"report: {out}\n"
    assert out.is_file()
    assert main(["report", str(run), "--out", str(tmp_path / "none" / "other.html")]) == 2
    assert "cannot be written" in capsys.readouterr().err
