import numpy as np
import pyarrow as pa
import pytest

from cluster_est.html_report.activity import (
    ActivityTail,
    LogActivity,
    busy_shares,
    read_activity,
    without_breaks,
)
from cluster_est.run_folder.log_segment import SCHEMA, SegmentWriter, slim


def batch(rows):
    return pa.RecordBatch.from_pylist(rows, schema=SCHEMA)


def row(number, status="ok", message="", **more):
    base = {"experiment": "e", "status": status, "message": message, "worker": "w0"}
    base |= {"key": "k", "want": "residuals", "search": "s", "purpose": "p", "values": [0.0]}
    return base | {"ended": 100.0 + number, "seconds": 1.0, "residuals": [1.0] * 50} | more


def write(path, batches, *, end=True):
    """Write a segment, and give the number of bytes before the last batch."""
    with path.open("wb") as file:
        writer = SegmentWriter(file, SCHEMA)
        before = 0
        for each in batches:
            file.flush()
            before = file.tell()
            writer.write(each)
        if end:
            writer.close()
    return before


def test_failures_are_counted_by_reason_whatever_numbers_it_holds(tmp_path):
    rows = [row(0)]
    rows += [row(i, "solver failure", f"stopped at t = {i}.5e-3 s") for i in range(1, 4)]
    rows += [row(4, "timeout", "too long", experiment="f")]
    write(tmp_path / "00000.arrows", [batch(rows[:2]), batch(rows[2:])])
    activity = read_activity(tmp_path, ended=False)
    assert activity.simulations == 5
    first, second = activity.failures
    assert (first.count, first.first, first.message) == (3, 1, "stopped at t = 1.5e-3 s")
    assert (second.status, second.count, second.first) == ("timeout", 1, 4)
    assert second.experiments == ("f",)


def test_only_what_is_new_is_read_and_a_torn_end_comes_later(tmp_path):
    path = tmp_path / "00000.arrows"
    batches = [batch([row(0)]), batch([row(1), row(2)])]
    before = write(path, batches)
    whole = path.read_bytes()
    tail = ActivityTail(tmp_path)
    seen = []
    for cut in (0, 3, before, before + 9, len(whole) - 60, len(whole)):
        with path.open("r+b") as file:  # the same file, as it grows
            file.truncate(0)
            file.write(whole[:cut])
        tail.read()
        seen.append(tail.counts.rows)
    assert seen == [0, 0, 1, 1, 1, 3]
    write(tmp_path / "00001.arrows", [batch([row(3, "timeout")])], end=False)
    tail.read()
    assert (tail.counts.rows, tail.counts.failed) == (4, 1)
    assert tail.activity.failures[0].first == 3
    tail.read()
    assert tail.counts.rows == 4


def test_a_segment_that_lost_its_large_columns_is_not_counted_twice(tmp_path):
    path = tmp_path / "00000.arrows"
    write(path, [batch([row(0)]), batch([row(1), row(2)])])
    tail = ActivityTail(tmp_path)
    tail.read()
    slim(path)
    tail.read()
    assert tail.counts.rows == 3
    assert len(tail.activity.ended) == 3


def test_there_need_not_be_a_log(tmp_path):
    assert read_activity(tmp_path / "none", ended=True).simulations == 0


def test_busy_shares_are_those_of_the_simulations():
    worker = np.array([0, 0, 1])
    ended, seconds = np.array([12.0, 20.0, 20.0]), np.array([2.0, 4.0, 10.0])
    activity = LogActivity(3, ("a", "b"), worker, ended, seconds, ())
    edges, shares = busy_shares(activity, 5)
    assert edges.tolist() == [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]
    assert shares[0] == pytest.approx([1.0, 0.0, 0.0, 1.0, 1.0])
    assert shares[1] == pytest.approx(np.ones(5))


def test_long_breaks_are_cut_out_of_the_time_line_and_short_ones_stay():
    ended = np.array([10.0, 1010.0, 12.0, 1015.0])
    activity = LogActivity(4, ("a",), np.zeros(4, int), ended, np.array([1.0, 2.0, 1.0, 1.0]), ())
    shorter, idle = without_breaks(activity)
    assert idle == pytest.approx(1008.0 - 12.0)
    assert shorter.ended == pytest.approx([10.0, 1010.0 - idle, 12.0, 1015.0 - idle])
    assert without_breaks(shorter)[1] == 0.0
