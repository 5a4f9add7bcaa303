"""A damaged segment of a log gives back only what was recorded, and says what is lost."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from support.damages import KINDS, damaged

from cluster_est.errors import RunFolderError
from cluster_est.report.activity import read_activity
from cluster_est.run_folder.evaluation_log import EvaluationLog, read_log
from cluster_est.run_folder.log_segment import SegmentReader, read_segment
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.running.records import TaskOrigin
from workers.messages import Outcome, Status, Task

ROWS, IN_A_BATCH = 120, 11
TORN = "ignore:.*torn end was dropped"


def write(folder: Path) -> bytes:
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


def without_seals(folder: Path) -> bytes:
    """The same as an earlier version wrote it."""
    table = read_log(folder)
    path = folder / "00000.arrows"
    with pa.ipc.new_stream(path, table.schema) as writer:
        for batch in table.to_batches():
            writer.write_batch(batch)
    return path.read_bytes()


def found_in(path: Path) -> tuple[list[str], SegmentReader]:
    found: list[str] = []
    reader = read_segment(path, lambda _, batch: found.extend(map(repr, batch.to_pylist())))
    return found, reader


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(12, 200), marks=pytest.mark.slow)])
def test_what_is_damaged_is_not_given_and_the_rest_is(
    tmp_path: Path, kind: str, seeds: range
) -> None:
    content, path = write(tmp_path), tmp_path / "00000.arrows"
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
        with pytest.raises(RunFolderError, match=r"00000.arrows: is damaged.*--resume"):
            read_log(tmp_path, ended=True)
        with pytest.raises(RunFolderError, match="is damaged"):
            read_activity(tmp_path, ended=True)


@pytest.mark.filterwarnings(TORN)
@pytest.mark.parametrize("kind", KINDS)
def test_a_log_that_was_mended_is_whole_again(tmp_path: Path, kind: str) -> None:
    content, path = write(tmp_path), tmp_path / "00000.arrows"
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
            again, mended = found_in(path)
            assert again == found
            assert mended.closed
            assert not mended.lost


@pytest.mark.parametrize("kind", KINDS)
def test_segments_of_earlier_versions_that_cannot_be_are_not_read(
    tmp_path: Path, kind: str
) -> None:
    write(tmp_path)
    content, path = without_seals(tmp_path), tmp_path / "00000.arrows"
    whole, reader = found_in(path)
    assert (len(whole), reader.closed, reader.damaged) == (ROWS, True, False)
    for seed in range(12):
        path.write_bytes(damaged(content, kind, seed))
        found, _ = found_in(path)
        assert len(found) <= ROWS
        logged = LoggedOutcomes(tmp_path)
        for row in range(len(logged)):
            logged.outcome(row, row)
        logged.close()


def test_an_unbelievable_row_of_an_earlier_version_is_not_read(tmp_path: Path) -> None:
    write(tmp_path)
    content, path = without_seals(tmp_path), tmp_path / "00000.arrows"
    path.write_bytes(content.replace(b"timeout", b"timeous"))
    found, reader = found_in(path)
    assert reader.damaged
    assert len(found) < ROWS
