"""The evaluation log gives back what was recorded, however the process that wrote it ended."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from cluster_est import evaluation_log
from cluster_est.errors import RunFolderError
from cluster_est.evaluation_log import SCHEMA, EvaluationLog, read_log
from cluster_est.runner import Origin
from workers.messages import Effect, Outcome, Status

EXPERIMENTS = [("first", "key1"), ("second", "key2")]
METADATA = {"config_hash": "abc", "format": "1"}

Row = tuple[Origin, Outcome]


@pytest.fixture(autouse=True)
def _no_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing be written because time has passed."""
    monkeypatch.setattr(evaluation_log, "SECONDS_PER_WRITE", np.inf)


def rows(count: int) -> list[Row]:
    """Simulations, every third of which failed."""
    made = []
    for i in range(count):
        origin = Origin("train", i // 2, "trial", i % 2, np.array([0.1 * i, -1.0]))
        outcome = Outcome(i, Status.OK, np.array([0.5, -i, 1e-300][: 2 + i % 2]), seconds=0.25)
        if i % 3 == 2:
            outcome = Outcome(i, Status.SOLVER_FAILURE, message=f"at {i}", worker="local-1")
        made.append((origin, outcome))
    return made


def open_log(folder: Path) -> EvaluationLog:
    return EvaluationLog(folder, "model", EXPERIMENTS, METADATA)


def write(folder: Path, recorded: list[Row], batch: int) -> EvaluationLog:
    """Record simulations, and flush after each `batch` of them."""
    log = open_log(folder)
    for first in range(0, len(recorded), batch):
        for origin, outcome in recorded[first : first + batch]:
            log.record(origin, outcome)
        log.flush()
    return log


def check(table: pa.Table, recorded: list[Row]) -> None:
    found = table.to_pylist()
    assert len(found) == len(recorded)
    for row, (origin, outcome) in zip(found, recorded, strict=True):
        assert row["search"] == origin.search
        assert row["evaluation"] == origin.evaluation
        assert row["purpose"] == origin.purpose
        assert row["experiment"] == EXPERIMENTS[origin.experiment][0]
        assert row["values"] == origin.values.tolist()
        assert (row["status"], row["message"]) == (str(outcome.status), outcome.message)
        assert (row["seconds"], row["worker"]) == (outcome.seconds, outcome.worker)
        if outcome.residuals is None:
            assert row["residuals"] is None
            assert np.isnan(row["cost"])
        else:
            assert row["residuals"] == outcome.residuals.tolist()
            assert row["cost"] == pytest.approx(np.sum(outcome.residuals**2), rel=1e-15)


@pytest.mark.parametrize("batch", [1, 4, 100])
def test_gives_back_what_was_recorded(tmp_path: Path, batch: int) -> None:
    recorded = rows(20)
    write(tmp_path / "log", recorded, batch).close()
    table = read_log(tmp_path / "log")
    check(table, recorded)
    assert table.schema.equals(SCHEMA)
    assert table.schema.metadata == {k.encode(): v.encode() for k, v in METADATA.items()}


def test_failures_alone_have_null_residuals(tmp_path: Path) -> None:
    recorded = [row for row in rows(20) if not row[1].ok]
    write(tmp_path, recorded, 3).close()
    check(read_log(tmp_path), recorded)


def test_a_row_says_its_effects_and_what_else_was_installed(tmp_path: Path) -> None:
    origin, outcome = rows(1)[0]
    effect = Effect("friction", "der(v)", "coulomb", ("v",))
    rehearsal = replace(origin, experiment=7, effects=(effect,), installed=("first (15%)", "key7"))
    write(tmp_path, [(origin, outcome), (rehearsal, outcome)], 2).close()
    own, other = read_log(tmp_path).to_pylist()
    assert (own["experiment"], own["effects"]) == ("first", [])
    assert (other["experiment"], other["effects"]) == ("first (15%)", ["friction"])
    assert own["key"] != other["key"]


def test_flushed_rows_can_be_read_while_the_log_is_open(tmp_path: Path) -> None:
    log = write(tmp_path, rows(8), 4)
    check(read_log(tmp_path), rows(8))
    log.close()
    log.close()
    check(read_log(tmp_path), rows(8))


def test_key_says_model_experiment_and_values(tmp_path: Path) -> None:
    recorded = rows(6)
    write(tmp_path / "a", recorded, 6).close()
    write(tmp_path / "b", recorded[::-1], 1).close()
    keys = read_log(tmp_path / "a")["key"].to_pylist()
    assert keys == read_log(tmp_path / "b")["key"].to_pylist()[::-1]
    assert len(set(keys)) == len(recorded)
    other = EvaluationLog(tmp_path / "c", "another model", EXPERIMENTS, {})
    for row in recorded:
        other.record(*row)
    other.close()
    assert not set(keys) & set(read_log(tmp_path / "c")["key"].to_pylist())


def test_torn_tail_is_dropped_with_a_warning(tmp_path: Path) -> None:
    recorded = rows(12)
    log = write(tmp_path, recorded[:8], 4)
    path = tmp_path / "00000.arrows"
    whole = path.stat().st_size
    for row in recorded[8:]:
        log.record(*row)
    log.close()
    content = path.read_bytes()
    for size in range(whole + 8, len(content) - 16, 37):
        path.write_bytes(content[:size])
        with pytest.warns(UserWarning, match="torn end was dropped"):
            table = read_log(tmp_path)
        check(table, recorded[:8])


def test_log_that_was_torn_at_once_is_empty(tmp_path: Path) -> None:
    write(tmp_path, rows(4), 4).close()
    path = tmp_path / "00000.arrows"
    for size in (0, 50):
        path.write_bytes(path.read_bytes()[:size])
        with pytest.warns(UserWarning, match="torn end was dropped"):
            table = read_log(tmp_path)
        check(table, [])
        assert table.schema.equals(SCHEMA)


def test_segments_are_rotated_and_read_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation_log, "BYTES_PER_SEGMENT", 1000)
    recorded = rows(40)
    write(tmp_path, recorded, 2).close()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [f"{i:05d}.arrows" for i in range(20)]
    check(read_log(tmp_path), recorded)
    torn = tmp_path / names[3]
    torn.write_bytes(torn.read_bytes()[:-100])
    with pytest.warns(UserWarning, match=names[3]):
        table = read_log(tmp_path)
    check(table, recorded[:6] + recorded[8:])


def test_many_rows_reach_the_disk_without_a_flush(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation_log, "ROWS_PER_WRITE", 5)
    log, recorded = open_log(tmp_path), rows(13)
    for row in recorded:
        log.record(*row)
    check(read_log(tmp_path), recorded[:10])
    log.close()
    check(read_log(tmp_path), recorded)


def test_row_that_comes_late_is_written_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation_log, "SECONDS_PER_WRITE", -1.0)
    log, recorded = open_log(tmp_path), rows(3)
    for count, row in enumerate(recorded, start=1):
        log.record(*row)
        check(read_log(tmp_path), recorded[:count])
    log.close()


def test_folder_without_segments_is_refused(tmp_path: Path) -> None:
    open_log(tmp_path).close()
    with pytest.raises(RunFolderError, match="holds none"):
        read_log(tmp_path)
