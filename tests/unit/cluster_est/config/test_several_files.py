"""One test in several files: the channels of each keep their own times, on one clock."""

import tomllib

import numpy as np
import pytest
from support.problems.springs import FMU

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.errors import ConfigError, DataError
from cluster_est.problem.tables.several_files import own_names

FAST, SLOW = np.arange(41) * 0.05, 0.02 + np.arange(20) * 0.1
EPOCH = 1_793_700_100_000
CONFIG = """
model.fmu = '{fmu}'
parameters.m = {{ start = 1.0, bounds = [0.1, 10.0] }}
[[experiments]]
id = "a"
data = {data}
time = "{time}"
inputs.F = "{force}"
outputs.y = "{position}"
{more}
"""


def logger(path, times, name, values, time="time"):
    rows = [f"{t},{v}" for t, v in zip(times, values, strict=True)]
    path.write_text("\n".join([f"{time},{name}", *rows]) + "\n", encoding="utf-8")


@pytest.fixture
def read(tmp_path, monkeypatch):
    """Reads a config of one experiment in files of this folder."""
    monkeypatch.chdir(tmp_path)

    def call(data='["run_f.csv", "run_p.csv"]', more="", **names):
        usual = {"time": "time", "force": "force", "position": "pos"}
        text = CONFIG.format(fmu=FMU, data=data, more=more, **usual | names)
        (tmp_path / "a.toml").write_text(text, encoding="utf-8")
        return ce.read_problem("a.toml")

    return call


def two(folder, fast=FAST, slow=SLOW, time=("time", "time"), names=("force", "pos")):
    for letter, times, own, name, values in zip(
        "fp", (fast, slow), time, names, (np.sin(FAST), np.cos(SLOW)), strict=True
    ):
        logger(folder / f"run_{letter}.csv", times, name, values, own)


def check_channels(problem):
    (run,) = problem.experiments
    (force,), (position,) = run.inputs, run.outputs
    np.testing.assert_allclose(force.times, FAST, atol=1e-9)
    np.testing.assert_allclose(position.times, SLOW, atol=1e-9)
    np.testing.assert_array_equal(position.values, np.cos(SLOW))
    assert (run.start, run.stop) == pytest.approx((0.0, SLOW[-1]))


def milliseconds(times, late=0.0):
    return [EPOCH + round(1e3 * (t + late)) for t in times]


class TestOneClock:
    @pytest.mark.parametrize("data", ['["run_f.csv", "run_p.csv"]', '["run_p.csv", "run_f.csv"]'])
    def test_each_channel_has_the_times_of_its_file(self, read, tmp_path, data):
        two(tmp_path)
        check_channels(read(data))

    @pytest.mark.parametrize("data", ['["run_f.csv", "run_p.csv"]', '["run_p.csv", "run_f.csv"]'])
    def test_dates_count_from_the_file_that_begins_first(self, read, tmp_path, data):
        """The position begins 20 ms after the force, in whatever order they are named."""
        two(tmp_path, milliseconds(FAST), milliseconds(SLOW))
        problem = read(data)
        check_channels(problem)
        (note,) = problem.tables[0].notes
        assert "counted in seconds from the first row, 2026-11-03 10:01:40.000 UTC" in note

    def test_the_unit_of_times_since_1970_is_not_missing(self, read, tmp_path, capsys):
        """They are converted, so check must not say that they are used as seconds."""
        two(tmp_path, milliseconds(FAST), milliseconds(SLOW), ("time_ms", "time_ms"))
        check_channels(read(time="time_ms"))
        assert main(["check", "a.toml", "--seconds", "0"]) == 0
        assert "time_ms' in ms" not in capsys.readouterr().out

    def test_a_pattern_in_a_list_means_the_files_of_one_test(self, read, tmp_path):
        two(tmp_path)
        check_channels(read('["run_*.csv"]'))

    def test_times_may_have_other_names_and_a_factor(self, read, tmp_path):
        two(tmp_path, 1e3 * FAST, 1e3 * SLOW, ("t_force", "t_pos"))
        check_channels(read(time="t_*", more='columns."t_*".factor = 0.001'))

    def test_names_in_several_files_get_the_part_of_the_file_name(self, read, tmp_path):
        two(tmp_path, names=("value", "value"))
        check_channels(read(force="f.value", position="p.value"))

    @pytest.mark.parametrize(
        ("stems", "own"),
        [
            (["run1_speed", "run1_torque"], ["speed", "torque"]),
            (["a-speed-1", "a-motor-current-1"], ["speed", "motor_current"]),
            (["a", "b"], ["a", "b"]),
            (["run", "run_2"], ["run", "run_2"]),
        ],
    )
    def test_the_part_of_the_file_name(self, stems, own):
        assert own_names(stems) == own


class TestOtherClocks:
    def test_a_shifted_clock_is_named_and_not_corrected(self, read, tmp_path):
        two(tmp_path, FAST + 10.0, SLOW + 11.5)
        problem = read()
        (position,) = problem.experiments[0].outputs
        np.testing.assert_allclose(position.times, SLOW + 11.5)
        (note,) = problem.tables[0].notes
        assert "as if the clock of run_p.csv were 1.52 s ahead; nothing was corrected" in note
        assert note.endswith("write columns.pos = { late = 1.52 }")
        (position,) = read(more="columns.pos.late = 1.5").experiments[0].outputs
        np.testing.assert_allclose(position.times, SLOW + 10.0)

    def test_a_short_file_is_named(self, read, tmp_path):
        two(tmp_path)
        logger(tmp_path / "run_f.csv", FAST[:20], "force", FAST[:20])
        (note,) = read().tables[0].notes
        assert note.startswith(
            "the times of run_f.csv go from 0 to 0.95 s, those of run_p.csv from"
        )
        assert "clock" not in note

    def test_times_that_all_begin_at_0_are_no_proof_of_one_start(self, read, tmp_path):
        two(tmp_path, slow=SLOW - 0.02)
        (note,) = read().tables[0].notes
        assert "they do not show whether the files began at the same time" in note

    @pytest.mark.parametrize(
        ("fast", "slow", "said"),
        [
            (FAST, milliseconds(SLOW), "run_p.csv.*counted from 1970"),
            (milliseconds(FAST), SLOW, "run_p.csv.*must count from the same time"),
            (milliseconds(FAST), milliseconds(SLOW, 3600.0), "no time in common"),
            (FAST, SLOW + 5.0, "run_p.csv go from 5.02 to 6.92 s.*no time in common"),
        ],
    )
    def test_clocks_without_a_common_time_are_refused(self, read, tmp_path, fast, slow, said):
        two(tmp_path, fast, slow)
        with pytest.raises(DataError, match=said):
            read()

    def test_a_wrong_value_is_named_with_its_file_and_row(self, read, tmp_path):
        two(tmp_path)
        path = tmp_path / "run_p.csv"
        lines = path.read_text().split("\n")
        lines[4] += "x"
        path.write_text("\n".join(lines))
        with pytest.raises(DataError, match=r"[^+]run_p.csv, column 'pos', row 5: must be"):
            read()

    def test_the_time_column_must_be_in_every_file(self, read, tmp_path):
        two(tmp_path, time=("time", "t"))
        with pytest.raises(DataError, match=r"every file of a test needs this column.*run_p.csv"):
            read()

    @pytest.mark.parametrize("key", ["rows = [0, 5]", 'split_by = "run"'])
    def test_keys_for_rows_are_refused(self, read, tmp_path, key):
        two(tmp_path)
        with pytest.raises(ConfigError, match=f"{key.split()[0]}: must not be used if data"):
            read(more=key)


class TestInit:
    def call(self, capsys, *files):
        assert main(["init", str(FMU), *files, "--out", "first.toml", "--overwrite"]) == 0
        with open("first.toml", "rb") as file:
            return tomllib.load(file), capsys.readouterr().out

    def two_tests(self, folder, late=(0.0, 0.0)):
        for test, begin in zip("12", late, strict=True):
            logger(folder / f"run{test}_force.csv", FAST, "F", np.sin(FAST))
            logger(folder / f"run{test}_position.csv", SLOW + begin, "y", np.cos(SLOW))
        return [f"run{test}_{name}.csv" for test in "12" for name in ("force", "position")]

    def test_files_of_one_test_are_joined_and_it_says_so(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        tree, said = self.call(capsys, *self.two_tests(tmp_path))
        assert "run1_force.csv, run1_position.csv: joined as the files of one test, 'run1'" in said
        assert [each["id"] for each in tree["experiments"]] == ["run1", "run2"]
        assert tree["experiments"][1]["data"] == ["run2_force.csv", "run2_position.csv"]
        assert tree["experiment_defaults"]["inputs"] == {"F": "F"}
        assert main(["check", "first.toml", "--seconds", "0"]) == 0

    @pytest.mark.parametrize(("late", "test"), [((1.5, 1.5), 1), ((0.0, 1.5), 2)])
    def test_files_with_other_times_are_not_joined_and_it_says_why(
        self, tmp_path, monkeypatch, capsys, late, test
    ):
        """No test is joined if one is not, and then none is said to be."""
        monkeypatch.chdir(tmp_path)
        tree, said = self.call(capsys, *self.two_tests(tmp_path, late))
        assert len(tree["experiments"]) == 4
        assert f"are files of one test, but the times of run{test}_position.csv go from" in said
        assert f"as if the clock of run{test}_position.csv were 1.52 s ahead" in said
        assert "joined" not in said

    def test_tests_with_the_same_columns_are_not_joined(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        for name in ("run_1", "run_2"):
            rows = zip(FAST, FAST, np.sin(FAST), strict=True)
            text = "\n".join(["time,F,y", *(",".join(map(str, row)) for row in rows)])
            (tmp_path / f"{name}.csv").write_text(f"{text}\n")
        tree, said = self.call(capsys, "run_1.csv", "run_2.csv")
        assert [each["data"] for each in tree["experiments"]] == ["run_1.csv", "run_2.csv"]
        assert "one test" not in said
