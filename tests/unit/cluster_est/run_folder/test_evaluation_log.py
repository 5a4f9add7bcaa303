import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.damages import KINDS, damaged

from cluster_est.errors import RunFolderError
from cluster_est.html_report.activity import read_activity
from cluster_est.run_folder.evaluation_log import ROWS_PER_WRITE, EvaluationLog, LogSettings
from cluster_est.run_folder.log_segment import (
    END_OF_STREAM,
    LARGE_LOG_COLUMNS,
    SCHEMA,
    SegmentReader,
    read_log,
    read_segment,
    repair,
)
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.running.resources import TaskOrigin
from workers.messages import Effect, Outcome, Status, Task, Trajectory

EXPERIMENTS = [("first", "key1"), ("second", "key2")]
METADATA = {"config_hash": "abc", "format": "1"}


def rows(count):
    """Simulations, every third of which failed."""
    made = []
    for i in range(count):
        origin = TaskOrigin(Task(i, i % 2, np.array([0.1 * i, -1.0])), "train", i // 2, "trial")
        outcome = Outcome(i, Status.OK, np.array([0.5, -i, 1e-300][: 2 + i % 2]), seconds=0.25)
        if i % 3 == 2:
            outcome = Outcome(i, Status.SOLVER_FAILURE, message=f"at {i}", worker="local-1")
        made.append((origin, outcome))
    return made


def trajectories(count):
    found = []
    for i in range(count):
        task = Task(i, i % 2, np.array([float(i)]), "trajectory")
        origin = TaskOrigin(task, "before", 0, "trajectory")
        path = Trajectory(("y", "z"), np.arange(40.0), np.arange(80.0).reshape(40, 2) + i)
        found.append((origin, Outcome(i, Status.OK, np.arange(30.0), path)))
    return found


def open_log(folder, settings=None, first=0, model="model", say=None):
    return EvaluationLog(folder, model, EXPERIMENTS, METADATA, settings, first, say=say)


def write(log, recorded, batch=4):
    """Record simulations, flush after each `batch` of them, and close the log."""
    log = open_log(log) if isinstance(log, Path) else log
    for first in range(0, len(recorded), batch):
        for origin, outcome in recorded[first : first + batch]:
            log.record(origin, outcome)
        log.flush()
    log.close()
    return log


def check(table, recorded):
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
def test_gives_back_what_was_recorded(tmp_path, batch):
    recorded = rows(20)
    write(tmp_path / "log", recorded, batch)
    table = read_log(tmp_path / "log")
    check(table, recorded)
    assert table.schema.equals(SCHEMA)
    assert table.schema.metadata == {k.encode(): v.encode() for k, v in METADATA.items()}


def test_a_row_says_its_effects_and_what_else_was_installed(tmp_path):
    origin, outcome = rows(1)[0]
    effect = Effect("friction", "der(v)", "coulomb", ("v",))
    task = replace(origin.task, experiment=7, effects=(effect,))
    rehearsal = replace(origin, task=task, installed=("first (15%)", "key7"))
    write(tmp_path, [(origin, outcome), (rehearsal, outcome)])
    own, other = read_log(tmp_path).to_pylist()
    assert (own["experiment"], own["effects"]) == ("first", [])
    assert (other["experiment"], other["effects"]) == ("first (15%)", ["friction"])
    assert own["key"] != other["key"]


def test_key_says_model_experiment_and_values(tmp_path):
    recorded = rows(6)
    write(tmp_path / "a", recorded)
    write(tmp_path / "b", recorded[::-1], 1)
    write(open_log(tmp_path / "c", model="another model"), recorded)
    keys, backwards, others = (read_log(tmp_path / each)["key"].to_pylist() for each in "abc")
    assert keys == backwards[::-1]
    assert len(set(keys)) == len(recorded)
    assert not set(keys) & set(others)


def test_a_torn_segment_is_read_and_mended_wherever_it_was_cut(tmp_path):
    recorded = rows(12)
    write(tmp_path, recorded)
    path = tmp_path / "00000.arrows"
    content = path.read_bytes()
    left, silent = set(), []
    for size in [*range(0, len(content), 61), len(content) - 8, len(content) - 3, len(content)]:
        path.write_bytes(content[:size])
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            table = read_log(tmp_path)
        assert all("incomplete and has been removed" in str(each.message) for each in said)
        silent += [size] if not said else []
        check(table, recorded[: table.num_rows])
        assert table.schema.equals(SCHEMA)
        left.add(table.num_rows)
        repair(path)
        assert path.exists() or table.num_rows == 0
        if path.exists():
            assert path.read_bytes().endswith(END_OF_STREAM)
            assert read_log(tmp_path)["key"].equals(table["key"])  # a warning would be an error
    assert {0, 4, 8, 12} <= left
    assert len(silent) <= len(left), "between two batches there is nothing to drop"
    assert path.read_bytes() == content


def test_segments_are_rotated_and_read_in_order(tmp_path):
    recorded = trajectories(300)
    write(open_log(tmp_path, LogSettings(max_megabytes=1.0)), recorded, 10)
    names = sorted(path.name for path in tmp_path.glob("*.arrows"))
    assert names == [f"{i:05d}.arrows" for i in range(len(names))]
    assert len(names) >= 3
    check(read_log(tmp_path), recorded)
    torn = tmp_path / names[1]
    torn.write_bytes(torn.read_bytes()[:-100])
    with pytest.warns(UserWarning, match=names[1]):
        table = read_log(tmp_path)
    found = [int(value) for (value,) in table["values"].to_pylist()]
    lost = sorted(set(range(300)).difference(found))
    assert found == sorted(found)
    assert lost == list(range(lost[0], lost[0] + 10)), "the last batch of that segment"


def test_many_rows_reach_the_disk_without_a_flush(tmp_path):
    log, recorded = open_log(tmp_path), rows(1 + ROWS_PER_WRITE)  # the first is written at once
    for row in recorded:
        log.record(*row)
    assert len(recorded) - read_log(tmp_path).num_rows < ROWS_PER_WRITE
    log.close()
    check(read_log(tmp_path), recorded)


@pytest.mark.filterwarnings("ignore:.*incomplete and has been removed")
def test_rows_are_written_at_once_or_a_moment_later_while_the_run_waits(tmp_path):
    log, (first, *others) = open_log(tmp_path), rows(3)
    log.record(*first)  # after a long time without any
    check(read_log(tmp_path), [first])
    for row in others:
        log.record(*row)
    while read_log(tmp_path).num_rows < 3:
        time.sleep(0.01)
    log.close()
    check(read_log(tmp_path), [first, *others])


def test_folder_without_segments_is_refused(tmp_path):
    open_log(tmp_path).close()
    with pytest.raises(RunFolderError, match="contains none"):
        read_log(tmp_path)


def test_nothing_that_is_there_is_written_over(tmp_path):
    write(tmp_path, rows(3))
    with pytest.raises(RunFolderError, match="cannot be written"):
        write(tmp_path, rows(1))


def test_a_log_that_cannot_be_written_is_said_with_a_row_that_follows(tmp_path):
    (tmp_path / "00001.arrows").mkdir()
    log = open_log(tmp_path, LogSettings(max_megabytes=1e-4))  # each segment holds one batch
    log.record(*rows(1)[0])
    log.record(*rows(1)[0])
    time.sleep(0.5)  # it is written meanwhile
    with pytest.raises(RunFolderError, match="cannot be written"):
        log.record(*rows(1)[0])


def test_trajectories_are_kept_and_what_was_wanted_is_said(tmp_path):
    write(tmp_path, [*trajectories(1), *rows(1)])
    with_path, without = read_log(tmp_path).to_pylist()
    assert (with_path["want"], without["want"]) == ("trajectory", "residuals")
    assert with_path["variables"] == ["y", "z"]
    assert with_path["times"] == list(range(40))
    assert with_path["trajectory"] == list(range(80))
    assert without["trajectory"] is None


def test_residuals_can_be_left_out(tmp_path):
    write(open_log(tmp_path, LogSettings(residuals=False)), [*trajectories(2), *rows(2)])
    table = read_log(tmp_path)
    for column in ("residuals", "trajectory", "times", "variables"):
        assert table[column].null_count == 4
    assert np.isfinite(table["cost"].to_numpy()).all()


def test_the_oldest_segments_of_a_full_log_lose_their_residuals(tmp_path):
    recorded, log = trajectories(300), open_log(tmp_path, LogSettings(max_megabytes=0.25))
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


def test_what_a_finished_run_leaves(tmp_path):
    recorded = [*trajectories(40), *rows(40)]
    log = write(tmp_path, recorded, 2)
    before = read_log(tmp_path)
    size = (tmp_path / "00000.arrows").stat().st_size
    log.let_residuals_go()
    after = read_log(tmp_path)
    assert (tmp_path / "00000.arrows").stat().st_size < size / 3
    assert [path.name for path in tmp_path.glob("*.slim")] == []
    for name in ("residuals", "trajectory", "times", "variables"):
        assert after[name].null_count == 80
    for name in set(SCHEMA.names).difference(LARGE_LOG_COLUMNS):
        assert str(after[name].to_pylist()) == str(before[name].to_pylist())  # costs may be NaN
    hashes = after["residuals_hash"].to_pylist()
    assert [h is None for h in hashes] == [outcome.residuals is None for _, outcome in recorded]
    assert len(set(hashes[:40])) == 1
    assert len(set(hashes[40:])) > 2


def test_residuals_that_are_wanted_stay(tmp_path):
    log = write(open_log(tmp_path, LogSettings(keep_residuals=True)), rows(6))
    log.let_residuals_go()
    check(read_log(tmp_path), rows(6))


def test_a_log_that_cannot_be_made_smaller_ends_no_run(tmp_path):
    (tmp_path / ".00000.slim").mkdir()  # where the smaller one would be written
    said: list[str] = []
    log = open_log(tmp_path, LogSettings(max_megabytes=0.05), say=said.append)
    write(log, trajectories(100), 1)
    log.let_residuals_go()
    assert read_log(tmp_path)["residuals"].null_count == 0
    full, stays = said
    assert "the log has reached 0.05 MB" in full
    assert "residuals cannot be removed from the log" in stays


ROWS, IN_A_BATCH = 120, 11
TORN = "ignore:.*incomplete and has been removed"


def written(folder: Path) -> bytes:
    """A closed segment of many batches."""
    log = EvaluationLog(folder, "model", [("e", "key")], {"format": "2"})
    for number in range(ROWS):
        origin = TaskOrigin(Task(number, 0, np.array([float(number)])), "train", number, "point")
        good = Outcome(number, Status.OK, number + np.arange(20.0), seconds=0.5, worker="w")
        late = Outcome(number, Status.TIMEOUT, None, None, f"at {number}", 1.0, "w")
        log.record(origin, late if number % 7 == 0 else good)
        if number % IN_A_BATCH == 0:
            log.flush()
    log.close()
    return (folder / "00000.arrows").read_bytes()


def found_in(path: Path) -> tuple[list[str], SegmentReader]:
    reader, batches = read_segment(path)
    return [repr(row) for _, batch in batches for row in batch.to_pylist()], reader


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(12, 200), marks=pytest.mark.slow)])
def test_what_is_damaged_is_not_given_and_the_rest_is(
    tmp_path: Path, kind: str, seeds: range
) -> None:
    content, path = written(tmp_path), tmp_path / "00000.arrows"
    whole, _ = found_in(path)
    assert len(whole) == ROWS
    for seed in seeds:
        path.write_bytes(damaged(content, kind, seed))
        found, reader = found_in(path)
        assert found == [row for row in whole if row in set(found)]
        assert reader.damaged or reader.torn or not reader.closed
        if kind in ("bit", "random bytes"):
            lost = IN_A_BATCH if reader.schema is not None else ROWS
            assert len(found) + reader.lost == ROWS or reader.lost == 0
            assert len(found) >= ROWS - lost
        with pytest.raises(RunFolderError, match=r"00000.arrows: the file is damaged.*--resume"):
            read_log(tmp_path, ended=True)
        with pytest.raises(RunFolderError, match="is damaged"):
            read_activity(tmp_path, ended=True)


@pytest.mark.filterwarnings(TORN)
@pytest.mark.parametrize("kind", KINDS)
def test_a_log_that_was_mended_is_whole_again(tmp_path: Path, kind: str) -> None:
    content, path = written(tmp_path), tmp_path / "00000.arrows"
    for seed in range(8):
        path.write_bytes(damaged(content, kind, seed))
        found, reader = found_in(path)
        logged = LoggedOutcomes(tmp_path)
        assert (len(logged), logged.lost) == (len(found), reader.lost)
        assert logged.damaged == reader.damaged
        for row in range(len(logged)):
            assert logged.outcome(row, row).seconds in (0.5, 1.0)
        logged.close()
        if path.exists():
            again, corrected = found_in(path)
            assert again == found
            assert corrected.closed
            assert not corrected.lost
