"""The report of a run: what stands in it, that nothing in it can act, and that runs keep going."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.cut_logs import cut
from support.reported import HOSTILE, Page, fitted_run
from support.truth.springs_with_friction import FRICTION, WIDTH, write_config

from cluster_est.cli import main
from cluster_est.report import write_report


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return fitted_run(tmp_path_factory.mktemp("fit") / "run", experiments=3)


@pytest.fixture(scope="module")
def closed(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("closed")
    config = write_config(folder)
    assert main(["close-loop", str(config), "--out", str(folder / "run")]) == 0
    return folder / "run"


def copied(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "copy"))


def data_of(page: Page) -> dict:
    (text,) = [text for attributes, text in page.scripts if attributes.get("id") == "data"]
    return json.loads(text)


def numbers(packed: dict) -> np.ndarray:
    if "f8" in packed:
        return np.frombuffer(base64.b64decode(packed["f8"]), "<f8")
    return np.frombuffer(base64.b64decode(packed["f4"]), "<f4") + packed["offset"]


def change(path: Path, table: str, column: str, value: object, row: int = 0) -> None:
    """Put something else into a cell of a table."""
    rows = pq.read_table(path / f"{table}.parquet").to_pylist()
    rows[row][column] = value
    pq.write_table(pa.Table.from_pylist(rows), path / f"{table}.parquet")


def test_the_verdict_comes_first_and_what_follows_is_in_order(run):
    page = Page(write_report(run))
    text = page.text
    order = ["The fit reached a solution", "The cost fell", "Errors before and after",
             "Parameters", "How the search went", "Workers and failures"]  # fmt: skip
    places = [text.index(each) for each in order]
    assert places == sorted(places)
    ids = [attributes["id"] for attributes in page.of("section") if "id" in attributes]
    assert ids == ["errors", "curves", "parameters", "search", "workers", "provenance"]


def test_curves_are_those_of_the_tables(run):
    data = data_of(Page(write_report(run)))
    assert [each["id"] for each in data["experiments"]] == ["e0", "e1", "e2"]
    assert [each["role"] for each in data["experiments"]] == ["train", "train", "test"]
    table = pq.read_table(run / "residuals.parquet").to_pandas()
    own = table[table.experiment == "e1"]
    (panel,) = data["experiments"][1]["outputs"]
    assert np.array_equal(numbers(panel["t"]), own.time)
    for name, column in (("measured", "measured"), ("after", "simulated")):
        assert numbers(panel[name]) == pytest.approx(own[column].to_numpy(), abs=1e-7)
    assert numbers(panel["before"]) == pytest.approx(own.simulated_before.to_numpy(), abs=1e-7)
    rest = own.measured - own.simulated
    assert numbers(panel["after_residual"]) == pytest.approx(rest.to_numpy(), abs=1e-7)


def test_the_curves_before_have_the_error_before(run):
    table = pq.read_table(run / "residuals.parquet").to_pandas()
    for row in pq.read_table(run / "errors.parquet").to_pylist():
        own = table[(table.experiment == row["experiment"]) & (table.output == row["output"])]
        for column, when in (("simulated_before", "before"), ("simulated", "after")):
            found = math.sqrt(((own.measured - own[column]) ** 2).mean())
            assert found == pytest.approx(row[f"rmse_{when}"], rel=1e-9)
    fine = pq.read_table(run / "trajectories.parquet")
    assert fine["simulated_before"].null_count == 0


def test_the_same_folder_gives_the_same_page(run, tmp_path):
    first = write_report(run, tmp_path / "a.html").read_bytes()
    assert write_report(run, tmp_path / "b.html").read_bytes() == first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.html", "b.html"]


def test_only_its_own_scripts_may_run_and_nothing_is_fetched(run):
    page = Page(write_report(run))
    (policy,) = [
        attributes["content"]
        for attributes in page.of("meta")
        if attributes.get("http-equiv") == "Content-Security-Policy"
    ]
    allowed = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert allowed["default-src"] == "'none'"
    assert not re.search(r"https?:|\*|unsafe-eval", policy)
    running = [text for attributes, text in page.scripts if "type" not in attributes]
    assert len(running) == 2
    for text in running:
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in allowed["script-src"]
    assert "'unsafe-inline'" not in allowed["script-src"]
    assert not page.of("link")
    assert not page.of("iframe")
    assert not [a for tag, a in page.elements if "src" in a]


def test_values_from_files_are_escaped_wherever_they_come_from(run, tmp_path):
    hostile = copied(run, tmp_path)
    for table, column in (
        ("errors", "output"), ("errors", "unit"), ("errors", "experiment"), ("residuals", "unit"),
        ("parameters", "label"), ("parameters", "unit"), ("searches", "search"),
        ("correlations", "label"), ("workers", "worker"),
    ):  # fmt: skip
        change(hostile, table, column, HOSTILE)
    table = pq.read_table(hostile / "residuals.parquet").to_pandas()
    table["experiment"] = HOSTILE + table["experiment"]
    table["output"] = HOSTILE + table["output"]
    pq.write_table(pa.Table.from_pandas(table), hostile / "residuals.parquet")
    facts = json.loads((hostile / "run.json").read_text())
    facts |= {"message": HOSTILE, "notes": [HOSTILE], "versions": {HOSTILE: HOSTILE}}
    facts["fmu"]["name"] = HOSTILE
    (hostile / "run.json").write_text(json.dumps(facts))
    page = Page(write_report(hostile))
    assert not page.of("img")
    assert not page.of("b")
    assert len(page.of("script")) == 3
    assert not [a for tag, a in page.elements if any(name.startswith("on") for name in a)]
    assert page.text.count(HOSTILE) >= 8
    experiments = data_of(page)["experiments"]
    assert {each["id"] for each in experiments} == {HOSTILE + f"e{i}" for i in range(3)}


def test_a_closed_loop_shows_its_effect_with_its_band_and_where_the_data_were(closed):
    page = Page(write_report(closed))
    for text in ("The missing effects were found", "der(v) += -k * tanh(v / width)", "Candidates"):
        assert text in page.text
    (shape,) = pq.read_table(closed / "shapes.parquet").to_pylist()
    x, y, low, high = (np.array(shape[name]) for name in ("x", "y", "lower", "upper"))
    assert (shape["part"], shape["variable"], shape["variable_unit"]) == ("der(v)", "v", "m/s")
    fast = np.abs(x) > 5.0 * WIDTH
    assert y[fast] == pytest.approx(-FRICTION * np.sign(x[fast]), rel=0.05)
    assert np.all((low <= y) & (y <= high))
    (row,) = [r for r in pq.read_table(closed / "effects.parquet").to_pylist()
              if r["coefficient"] == "k"]  # fmt: skip
    assert (high - low)[fast] == pytest.approx(2 * 1.96 * row["std_error"], rel=0.01)
    samples = pq.read_table(closed / "trajectories.parquet").to_pandas()
    train = pq.read_table(closed / "errors.parquet").to_pandas().query("role == 'train'")
    expected = samples[samples.experiment.isin(train.experiment)]
    assert sum(shape["counts"]) == len(expected)
    assert "shape-" in " ".join(data_of(page)["figures"])


def test_a_run_that_goes_on_says_so_and_loads_itself_again(run, tmp_path):
    going = copied(run, tmp_path)
    facts = json.loads((going / "run.json").read_text())
    kept = {k: facts[k] for k in ("format", "seed", "started", "fmu", "versions", "config_hash")}
    (going / "run.json").write_text(json.dumps({**kept, "status": "running", "verdict": None}))
    for path in going.glob("*.parquet"):
        path.unlink()
    cut(going / "evaluations", 20, torn=100)
    page = Page(write_report(going, reload=7.0))
    assert page.of("body") == [{"data-reload": "7.0"}]
    assert "The run goes on" in page.text
    assert "every 7 s" in page.text
    ids = [attributes["id"] for attributes in page.of("section") if "id" in attributes]
    assert ids == ["search", "workers", "provenance"]
    assert page.of("body") != Page(write_report(going)).of("body")


def test_an_interrupted_run_shows_what_is_there(run, tmp_path):
    left = copied(run, tmp_path)
    for path in [*left.glob("*.parquet"), left / "progress.jsonl", left / "config.toml"]:
        path.unlink()
    shutil.rmtree(left / "evaluations")
    (left / "run.json").write_text('{"status": "interrupted", "message": "interrupted; early"}')
    text = Page(write_report(left)).text
    assert "The run was interrupted" in text
    assert "It left no results" in text


@pytest.mark.parametrize(("name", "said"), [("nothing", "has no run.json"), ("run", "damaged")])
def test_what_is_no_run_or_damaged_is_said_in_a_sentence(run, tmp_path, capsys, name, said):
    folder = tmp_path / "nothing"
    if name == "run":
        folder = copied(run, tmp_path)
        (folder / "parameters.parquet").write_bytes(b"PAR1 not really")
    assert main(["report", str(folder)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_runs_of_versions_without_curves_before_have_a_report(run, tmp_path):
    old = copied(run, tmp_path)
    for name in ("residuals", "trajectories"):
        table = pq.read_table(old / f"{name}.parquet").drop_columns(["simulated_before"])
        pq.write_table(table, old / f"{name}.parquet")
    panel = data_of(Page(write_report(old)))["experiments"][0]["outputs"][0]
    assert "before" not in panel
    assert "after" in panel


def test_a_fit_writes_its_report_and_ends_as_it_would_without(tmp_path, capsys):
    config = write_config(tmp_path)
    run = ["fit", str(config), "--overwrite", "--out", str(tmp_path / "run")]
    assert main([*run, "--no-report"]) == 0
    assert not (tmp_path / "run" / "report.html").exists()
    assert main(run) == 0
    assert (tmp_path / "run" / "report.html").is_file()
    assert f"report: {tmp_path / 'run' / 'report.html'}" in capsys.readouterr().out
    (tmp_path / "run" / "report.html").unlink()
    (tmp_path / "run" / "report.html").mkdir()
    assert main(run) == 0
    error = capsys.readouterr().err
    assert "the report could not be written" in error


def test_many_long_experiments_stay_small_and_keep_their_peaks(run, tmp_path):
    long = copied(run, tmp_path)
    times, generator = np.arange(10_000) * 0.01, np.random.default_rng(0)
    tables, spikes = [], []
    for number in range(20):
        measured = np.sin(times) + 0.1 * generator.normal(size=len(times))
        spikes.append(int(generator.integers(len(times))))
        measured[spikes[-1]] = 50.0
        columns = {
            "experiment": np.full(len(times), f"run{number}"),
            "role": np.full(len(times), "train"),
            "output": np.full(len(times), "y"),
            "time": times,
            "measured": measured,
            "simulated": np.sin(times),
            "simulated_before": np.cos(times),
            "residual": measured - np.sin(times),
        }
        tables.append(pa.table(columns))
    pq.write_table(pa.concat_tables(tables), long / "residuals.parquet")
    path = write_report(long)
    assert path.stat().st_size < 8_000_000
    experiments = data_of(Page(path))["experiments"]
    assert len(experiments) == 20
    for spike, each in zip(spikes, experiments, strict=True):
        (panel,) = each["outputs"]
        at = numbers(panel["t"]) == times[spike]
        assert numbers(panel["measured"])[at] == pytest.approx([50.0])


def test_searches_of_one_name_are_points_in_their_order(closed):
    figure = data_of(Page(write_report(closed)))["figures"]["convergence"]
    lines = [json.loads(line) for line in (closed / "progress.jsonl").read_text().splitlines()]
    lines = [line for line in lines if "search" in line]
    drawn = {
        x: y for trace in figure["traces"] for x, y in zip(trace["x"], trace["y"], strict=True)
    }
    assert drawn == {
        number: pytest.approx(line["cost"], rel=1e-6)
        for number, line in enumerate(lines)
        if line["cost"] is not None
    }


def test_a_report_goes_where_it_is_told(run, tmp_path, capsys):
    out = tmp_path / "other.html"
    assert main(["report", str(run), "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"report: {out}\n"
    assert out.is_file()
    assert main(["report", str(run), "--out", str(tmp_path / "none" / "other.html")]) == 2
    assert "must be written but cannot be" in capsys.readouterr().err
