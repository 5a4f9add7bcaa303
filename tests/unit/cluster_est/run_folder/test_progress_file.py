import math

import pytest

from cluster_est.errors import RunFolderError
from cluster_est.methods.method import Progress
from cluster_est.run_folder.run_progress import MOST_PROGRESS_BYTES, ProgressFile, ProgressTail
from cluster_est.running.resources import RunSnapshot, SearchIteration


def line(search, number, cost, ending=""):
    return SearchIteration(search, Progress(number, cost, ending=ending), 10 * number)


def snapshot(seconds):
    return RunSnapshot("train", Progress(1, 2.0), 5, 10, 1, 3, 4, seconds)


def test_what_was_written_is_read_once(tmp_path):
    path = tmp_path / "progress.jsonl"
    file, tail = ProgressFile(path), ProgressTail(path)
    file.iteration(line("train", 0, math.nan))
    file.show(snapshot(1.5))
    first = tail.new()
    assert [(each.search, each.iteration) for each in first] == [("train", 0)]
    assert math.isnan(first[0].cost)
    assert (tail.state.busy, tail.state.workers, tail.state.seconds) == (3, 4, 1.5)
    assert math.isnan(tail.state.left)
    assert tail.new() == []
    file.iteration(line("train", 1, 2.5, "converged"))
    (second,) = tail.new()
    assert (second.cost, second.ending, second.evaluations) == (2.5, "converged", 10)


def test_half_a_line_waits_for_its_end(tmp_path):
    path = tmp_path / "progress.jsonl"
    file = ProgressFile(path)
    file.iteration(line("a", 0, 1.0))
    file.iteration(line("b", 0, 2.0))
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    tail = ProgressTail(path)
    assert [each.search for each in tail.new()] == ["a"]
    path.write_bytes(whole)
    assert [each.search for each in tail.new()] == ["b"]


def test_it_stays_small_and_begins_anew_with_the_last_lines(tmp_path):
    path = tmp_path / "progress.jsonl"
    file, tail = ProgressFile(path), ProgressTail(path)
    file.iteration(line("first", 7, 0.5))
    seen = tail.new()
    long = "of a long name " * (MOST_PROGRESS_BYTES // 200)  # some ten lines fill the file
    for number in range(40):
        file.iteration(line(long, number, 1.0))
        assert path.stat().st_size < 1.5 * MOST_PROGRESS_BYTES
        seen += tail.new()
    assert max(each.iteration for each in seen if each.search == long) == 39
    assert [each.iteration for each in ProgressTail(path).new() if each.search == "first"] == [7]


@pytest.mark.parametrize("text", ["{}", "nonsense", '{"now": 1}', "[1]", '{"search": "a"}'])
def test_lines_of_other_versions_are_left_out(tmp_path, text):
    path = tmp_path / "progress.jsonl"
    assert ProgressTail(path).new() == []  # there need not be a file
    path.write_text(text + "\n")
    tail = ProgressTail(path)
    assert tail.new() == []
    assert tail.state is None


def test_wherever_the_file_of_an_ended_run_was_cut_it_is_damaged(tmp_path):
    path = tmp_path / "progress.jsonl"
    file = ProgressFile(path)
    file.iteration(line("a", 0, 1.0))
    file.end()
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        tail = ProgressTail(path)
        tail.new()
        with pytest.raises(RunFolderError, match="damaged"):
            tail.check()
    path.write_bytes(whole)
    tail = ProgressTail(path)
    assert [each.search for each in tail.new()] == ["a"]
    tail.check()
