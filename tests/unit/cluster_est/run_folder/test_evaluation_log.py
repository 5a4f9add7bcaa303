"""The evaluation log gives back what was recorded, however the process that wrote it ended."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from cluster_est.errors import RunFolderError
from cluster_est.run_folder import evaluation_log
from cluster_est.run_folder.evaluation_log import SCHEMA, EvaluationLog, LogSettings, read_log
from cluster_est.run_folder.log_format import END_OF_STREAM, LARGE, mend
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.running.records import TaskOrigin
from workers.messages import Effect, Outcome, Status, Task, Trajectory

EXPERIMENTS = [("first", "key1"), ("second", "key2")]
METADATA = {"config_hash": "abc", "format": "1"}

Row = tuple[TaskOrigin, Outcome]


@pytest.fixture(autouse=True)
def _no_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing be written because time has passed."""
    monkeypatch.setattr(evaluation_log, "SECONDS_PER_WRITE", np.inf)


def rows(count: int) -> list[Row]:
    """Simulations, every third of which failed."""
    made = []
    for i in range(count):
        origin = TaskOrigin(Task(i, i % 2, np.array([0.1 * i, -1.0])), "train", i // 2, "trial")
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
        assert row["experiment"] == EXPERIMENTS[origin.task.experiment][0]
        assert row["values"] == origin.task.values.tolist()
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
    task = replace(origin.task, experiment=7, effects=(effect,))
    rehearsal = replace(origin, task=task, installed=("first (15%)", "key7"))
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
    names = sorted(path.name for path in tmp_path.glob("*.arrows"))
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


def test_a_torn_segment_is_mended_wherever_it_was_cut(tmp_path: Path) -> None:
    recorded = rows(12)
    write(tmp_path, recorded, 4).close()
    path = tmp_path / "00000.arrows"
    content = path.read_bytes()
    left = set()
    for size in [*range(0, len(content), 61), len(content) - 8, len(content) - 3, len(content)]:
        path.write_bytes(content[:size])
        mend(path)
        if not path.exists():
            left.add(0)
            continue
        assert path.read_bytes().endswith(END_OF_STREAM)
        table = read_log(tmp_path)  # a warning would be an error
        check(table, recorded[: table.num_rows])
        left.add(table.num_rows)
    assert left == {0, 4, 8, 12}
    assert path.read_bytes() == content


def test_a_resumed_log_goes_on_behind_what_is_there(tmp_path: Path) -> None:
    recorded = rows(9)
    write(tmp_path, recorded[:6], 3).close()
    log = EvaluationLog(tmp_path, "model", EXPERIMENTS, METADATA, first_segment=1)
    for row in recorded[6:]:
        log.record(*row)
    log.close()
    check(read_log(tmp_path), recorded)


def test_nothing_that_is_there_is_written_over(tmp_path: Path) -> None:
    write(tmp_path, rows(3), 3).close()
    log = open_log(tmp_path)
    log.record(*rows(1)[0])
    with pytest.raises(RunFolderError, match="must be written but cannot be"):
        log.flush()


def test_rows_are_written_while_the_run_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation_log, "SECONDS_PER_WRITE", 0.02)
    log = open_log(tmp_path)
    log._written = np.inf  # nothing that is recorded comes late
    log.record(*rows(1)[0])
    assert log._writer is not None
    while not list(tmp_path.glob("*.arrows")):
        log._writer.join(0.01)
    log.close()
    check(read_log(tmp_path), rows(1))


def test_a_log_that_cannot_be_written_is_said_with_the_next_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation_log, "SECONDS_PER_WRITE", 0.02)
    (tmp_path / "00000.arrows").write_bytes(b"")
    log = open_log(tmp_path)
    log._written = np.inf
    log.record(*rows(1)[0])
    assert log._writer is not None
    log._writer.join()
    with pytest.raises(RunFolderError, match="must be written but cannot be"):
        log.record(*rows(1)[0])


def trajectories(count: int) -> list[Row]:
    found = []
    for i in range(count):
        task = Task(i, i % 2, np.array([float(i)]), "trajectory")
        origin = TaskOrigin(task, "before", 0, "trajectory")
        path = Trajectory(("y", "z"), np.arange(40.0), np.arange(80.0).reshape(40, 2) + i)
        found.append((origin, Outcome(i, Status.OK, np.arange(30.0), path)))
    return found


def test_trajectories_are_kept_and_what_was_wanted_is_said(tmp_path: Path) -> None:
    write(tmp_path, [*trajectories(1), *rows(1)], 2).close()
    with_path, without = read_log(tmp_path).to_pylist()
    assert (with_path["want"], without["want"]) == ("trajectory", "residuals")
    assert with_path["variables"] == ["y", "z"]
    assert with_path["times"] == list(range(40))
    assert with_path["trajectory"] == list(range(80))
    assert without["trajectory"] is None


def test_residuals_can_be_left_out(tmp_path: Path) -> None:
    log = EvaluationLog(tmp_path, "model", EXPERIMENTS, METADATA, LogSettings(residuals=False))
    for row in [*trajectories(2), *rows(2)]:
        log.record(*row)
    log.close()
    table = read_log(tmp_path)
    for column in ("residuals", "trajectory", "times", "variables"):
        assert table[column].null_count == 4
    assert table["cost"].null_count == 0
    assert np.isfinite(table["cost"].to_numpy()).all()


def test_the_oldest_segments_of_a_full_log_lose_their_residuals(tmp_path: Path) -> None:
    recorded = trajectories(300)
    settings = LogSettings(megabytes=0.25)
    log = EvaluationLog(tmp_path, "model", EXPERIMENTS, METADATA, settings)
    for first in range(0, 300, 10):
        for row in recorded[first : first + 10]:
            log.record(*row)
        log.flush()
        size = sum(path.stat().st_size for path in tmp_path.iterdir())
        assert size <= 0.25 * 2**20 * 9 / 8  # the segment that is being written comes on top
    log.close()
    table = read_log(tmp_path)
    assert table["values"].to_pylist() == [[float(i)] for i in range(300)]
    missing = [residuals is None for residuals in table["residuals"].to_pylist()]
    assert missing == sorted(missing, reverse=True)
    assert 0 < sum(missing) < 300


def test_a_log_of_the_first_format_can_be_read(tmp_path: Path) -> None:
    write(tmp_path, rows(4), 4).close()
    table = read_log(tmp_path).drop_columns(["want", "variables", "times", "trajectory"])
    with pa.ipc.new_stream(tmp_path / "00000.arrows", table.schema) as writer:
        writer.write_table(table)
    check(read_log(tmp_path), rows(4))


def test_segments_of_a_version_without_ends_are_read_with_those_that_have_them(tmp_path):
    recorded = rows(8)
    write(tmp_path, recorded[:4], 2).close()
    old = tmp_path / "00000.arrows"
    table = read_log(tmp_path).drop_columns(["ended"])
    with old.open("wb") as file, pa.ipc.new_stream(file, table.schema) as writer:
        writer.write_table(table)
    log = EvaluationLog(tmp_path, "model", EXPERIMENTS, METADATA, first_segment=1)
    for origin, outcome in recorded[4:]:
        log.record(origin, outcome)
    log.close()
    both = read_log(tmp_path)
    check(both, recorded)
    ended = both["ended"].to_pylist()
    assert ended[:4] == [None] * 4
    assert ended[4:] == sorted(ended[4:])
    logged = LoggedOutcomes(tmp_path)
    for row, (_, outcome) in enumerate(recorded):
        found = logged.outcome(row, row)
        assert (found.status, found.message, found.seconds) == (
            outcome.status,
            outcome.message,
            outcome.seconds,
        )
        assert (found.residuals is None) == (outcome.residuals is None)


def test_what_a_finished_run_leaves(tmp_path: Path) -> None:
    recorded = [*trajectories(40), *rows(40)]
    log = write(tmp_path, recorded, 2)
    log.close()
    before = read_log(tmp_path)
    size = (tmp_path / "00000.arrows").stat().st_size
    log.let_residuals_go()
    after = read_log(tmp_path)
    assert (tmp_path / "00000.arrows").stat().st_size < size / 3
    assert [path.name for path in tmp_path.glob("*.slim")] == []
    for name in ("residuals", "trajectory", "times", "variables"):
        assert after[name].null_count == 80
    for name in set(SCHEMA.names).difference(LARGE):
        assert str(after[name].to_pylist()) == str(before[name].to_pylist())  # costs may be NaN
    hashes = after["residuals_hash"].to_pylist()
    assert [h is None for h in hashes] == [outcome.residuals is None for _, outcome in recorded]
    assert len(set(hashes[:40])) == 1
    assert len(set(hashes[40:])) > 2


def test_residuals_that_are_wanted_stay(tmp_path: Path) -> None:
    settings = LogSettings(keep_residuals=True)
    log = EvaluationLog(tmp_path, "model", EXPERIMENTS, METADATA, settings)
    for row in rows(6):
        log.record(*row)
    log.close()
    log.let_residuals_go()
    check(read_log(tmp_path), rows(6))


def test_a_log_that_cannot_be_made_smaller_ends_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Path) -> None:
        raise OSError("there is no room")

    monkeypatch.setattr(evaluation_log, "slim", full)
    said: list[str] = []
    settings = LogSettings(megabytes=0.05)
    log = EvaluationLog(tmp_path, "model", EXPERIMENTS, METADATA, settings, say=said.append)
    for row in trajectories(100):
        log.record(*row)
        log.flush()
    log.close()
    log.let_residuals_go()
    assert read_log(tmp_path)["residuals"].null_count == 0
    full_log, no_room = said
    assert "the log has reached 0.05 MB" in full_log
    assert "residuals stay in the log, because there is no room" in no_room
