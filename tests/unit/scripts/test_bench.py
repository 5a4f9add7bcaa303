"""The runner of the benches, with a bench that measures nothing."""

import sys
from types import ModuleType

import bench
import pyarrow.parquet as pq
import pytest

NAMES = sorted(p.stem for p in bench.FOLDER.glob("*.py") if p.stem not in ("__init__", "common"))


@pytest.fixture
def counting(monkeypatch):
    """A bench that says its options, in the place of one of the same name."""
    module = ModuleType("benches.start", "Counts.\n\nUp to `most`.")
    module.OPTIONS = {"most": 2, "sizes": [0.5], "loud": False}

    def rows(options):
        for number in range(options.most):
            yield {"number": number, "share": number / 3.0, "loud": options.loud}
        yield {"sizes": str(options.sizes)}

    module.rows = rows
    monkeypatch.setitem(sys.modules, "benches.start", module)


def test_rows_are_printed_below_their_heads(counting, capsys):
    assert bench.main(["start", "--most", "3", "--loud", "--sizes", "1", "2"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        ["number", "share", "loud"],
        ["0", "0", "yes"],
        ["1", "0.3333", "yes"],
        ["2", "0.6667", "yes"],
        ["sizes"],
        ["[1.0,", "2.0]"],
    ]


def test_a_history_keeps_the_rows_of_every_run_with_date_commit_and_options(counting, tmp_path):
    folder = tmp_path / "history"
    bench.main(["start", "--history", str(folder)])
    bench.main(["start", "--most", "1", "--history", str(folder)])
    rows = pq.read_table(folder / "start.parquet").to_pylist()
    assert [row["number"] for row in rows] == [0, 1, None, 0, None]
    assert [row["sizes"] for row in rows] == [None, None, "[0.5]", None, "[0.5]"]
    assert {row["options"] for row in rows} == {
        "most=2 sizes=[0.5] loud=False",
        "most=1 sizes=[0.5] loud=False",
    }
    assert all(row["date"].startswith("20") and row["commit"] is not None for row in rows)
    assert [p.name for p in folder.iterdir()] == ["start.parquet"]


def test_without_a_name_the_benches_are_listed(capsys):
    assert bench.main([]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in listed] == NAMES
    assert bench.main(["no_such"]) == 1


@pytest.mark.parametrize("name", NAMES)
def test_every_bench_says_what_it_measures(name):
    text = (bench.FOLDER / f"{name}.py").read_text(encoding="utf-8")
    assert bench.summary(text).endswith(".")
    assert "\nOPTIONS" in text
    assert "\ndef rows(" in text
