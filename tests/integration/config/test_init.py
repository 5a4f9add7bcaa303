import re
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.described import real, write_fmu
from support.problems.springs import FMU, ROOT
from support.thinning import thinned

import cluster_est as ce
from cluster_est.cli import main
from workers.fmu.description import describe

TIMES = np.arange(50) * 0.02
FORCE = np.sin(0.5 * np.pi * TIMES / TIMES[-1])
STEP = np.where(TIMES > 0.1, 1.0, 0.0)
CHECK = ["check", "first.toml", "--seconds", "0"]


def table(path, columns=None, **more):
    """A table of the columns, of which the names may be no words."""
    given = (columns or {}) | more
    if path.suffix == ".csv":
        rows = [",".join(map(str, row)) for row in zip(*given.values(), strict=True)]
        path.write_text("\n".join([",".join(given), *rows]) + "\n", encoding="utf-8")
    else:
        pq.write_table(pa.table(given), path)
    return path


def factors(tree):
    """What the columns of the first experiment are multiplied with."""
    columns = tree["experiments"][0].get("columns", {})
    return {name: each["factor"] for name, each in columns.items()}


@pytest.fixture
def written(tmp_path, monkeypatch, capsys):
    """Runs init in a folder and gives the text, the tree, and what it printed."""
    monkeypatch.chdir(tmp_path)

    def call(*data, fmu=FMU, out="first.toml", given=()):
        maps = [text for each in given for text in ("--map", each)]
        assert main(["init", str(fmu), *(str(d) for d in data), *maps, "--out", out]) == 0
        text = Path(out).read_text(encoding="utf-8")
        return text, tomllib.loads(text), capsys.readouterr().out

    return call


class TestWhereColumnsMatch:
    def test_the_config_passes_check_as_it_is(self, written, tmp_path, capsys):
        files = [table(tmp_path / f"{n}.csv", time=TIMES, F=FORCE, y=FORCE) for n in "abc"]
        text, tree, said = written(*files)
        assert "fill in" not in said
        assert main(CHECK) == 0
        assert [e["id"] for e in tree["experiments"]] == ["a", "b", "c"]
        assert [e.get("role", "train") for e in tree["experiments"]] == ["train", "train", "test"]
        assert tree["experiment_defaults"]["inputs"] == {"F": "F"}
        assert all(set(e) <= {"id", "data", "role"} for e in tree["experiments"])
        assert tree["parameters"]["k"] == {"start": 25.0, "bounds": [2.5, 250.0]}
        assert "[N/m] stiffness of the spring" in text
        assert '# x = { start = 0.0, per = "experiment" }' in text
        assert "sigma" not in tree["experiment_defaults"]  # of one output alone
        assert "# sigma.y = " in text
        assert "sigma_known" not in text
        result = ce.fit(ce.read_problem("first.toml", ["parameters.m.fixed=true"]))
        assert np.isfinite(result.cost)

    @pytest.mark.parametrize(
        ("force", "position", "time"),
        [
            ("f", "Y", "Time [s]"),
            ("F [N]", "y_", "t"),
            ("F (N)", " y", "TIME"),
            ("F / N", "y", "t"),
        ],
    )
    def test_spelling_does_not_matter(self, written, tmp_path, force, position, time):
        columns = {time: TIMES, force: FORCE, position: FORCE}
        _, tree, said = written(table(tmp_path / "a.parquet", columns))
        assert "fill in" not in said
        assert main(CHECK) == 0
        (experiment,) = tree["experiments"]
        assert experiment["inputs"] == {"F": force.strip()}
        assert experiment["time"] == time

    def test_paths_start_from_the_config(self, written, tmp_path):
        (tmp_path / "data").mkdir()
        path = table(tmp_path / "data" / "a.csv", time=TIMES, F=FORCE, y=FORCE)
        _, tree, _ = written(path, out="configs/first.toml")
        assert tree["experiments"][0]["data"] == "../data/a.csv"
        assert main(["check", "configs/first.toml", "--seconds", "0"]) == 0

    @pytest.mark.parametrize(
        ("time", "force", "position"),
        [("time [ms]", "F [kN]", "y [mm]"), ("time_ms", "F_kN", "y_mm")],
    )
    def test_units_that_differ_are_converted(self, written, tmp_path, time, force, position):
        columns = {time: TIMES * 1e3, force: FORCE, position: FORCE, "v [furlong/h]": FORCE}
        text, tree, said = written(table(tmp_path / "a.parquet", columns))
        assert "fill in" not in said
        assert factors(tree) == {time: 1e-3, force: 1e3, position: 1e-3}
        assert "v [furlong/h] is in furlong/h, but v is in m/s; if" in text
        problem = ce.read_problem("first.toml")
        assert problem.experiments[0].stop == pytest.approx(TIMES[-1])
        assert problem.experiments[0].inputs[0].values.max() == 1000.0


class TestWhereAnInputJumps:
    MOVING = FORCE + np.repeat([0.0, 1.0, -1.0, 0.5, 2.0], 10)

    @pytest.mark.parametrize("signal", [STEP, MOVING])
    @pytest.mark.parametrize(("name", "given"), [("F", ()), ("Load cell", ("F=Load cell",))])
    def test_it_is_held_in_each_file_in_which_it_does(self, written, tmp_path, signal, name, given):
        one = table(tmp_path / "one.csv", {"time": TIMES, name: signal, "y": FORCE})
        other = table(tmp_path / "other.csv", {"time": TIMES, name: FORCE, "y": FORCE})
        written(one, other, given=given)
        held, straight = ce.read_problem("first.toml").experiments
        assert held.inputs[0].interpolation == "hold"
        assert straight.inputs[0].interpolation == "linear"

    def test_check_names_it_where_it_is_not_held(self, written, tmp_path, capsys):
        data = table(tmp_path / "one.csv", time=TIMES, F=self.MOVING, y=FORCE)
        text, _, _ = written(data)
        text = re.sub(r"inputs.F = {.*}", 'inputs.F = "F"', text)
        Path("first.toml").write_text(text, encoding="utf-8")
        main(["check", "first.toml"])
        said = " ".join(capsys.readouterr().out.split())
        assert re.search(r"input F \(column \S+\) jumps between samples in .*\(4 times\)", said)
        assert re.search(r"the largest jump is from \S+ to \S+ .*at t = [\d.]+ s", said)


class TestWhereExperimentsAreAlike:
    def test_what_they_share_stands_once(self, written, tmp_path):
        """Sixteen tables, one line to fill in, and one guess of each output's noise."""
        files = []
        for i in range(16):
            noise = np.random.default_rng(i).normal(size=50)
            noisy = {"y": FORCE + 0.01 * noise, "v": FORCE + 0.02 * noise}
            files.append(table(tmp_path / f"run{i}.csv", noisy, time=TIMES, force=FORCE))
        text, tree, said = written(*files)
        assert said.count("fill in") == 1
        assert "# Defaults of all experiments; an experiment below may have its own value." in text
        assert tree["experiment_defaults"]["time"] == "time"
        assert tree["experiment_defaults"]["outputs"] == {"y": "y", "v": "v"}
        sigma = tree["experiment_defaults"]["sigma"]
        assert sigma == pytest.approx({"y": 0.01, "v": 0.02}, rel=0.2)
        assert tree["experiment_defaults"]["sigma_known"] is False
        assert all(set(e) <= {"id", "data", "role"} for e in tree["experiments"])
        Path("first.toml").write_text(text.replace("FILL IN: force?", "force"), encoding="utf-8")
        assert main(CHECK) == 0
        runs = ce.read_problem("first.toml").experiments
        assert {o.sigma for r in runs for o in r.outputs if o.variable == "y"} == {sigma["y"]}
        assert not any(o.has_sigma for r in runs for o in r.outputs)

    def test_what_differs_stays_with_each(self, written, tmp_path):
        one = table(tmp_path / "one.csv", time=TIMES, F=FORCE, y=FORCE)
        other = table(tmp_path / "other.csv", t=TIMES, F=FORCE, y=FORCE)
        _, tree, _ = written(one, other)
        assert [e["time"] for e in tree["experiments"]] == ["time", "t"]
        assert tree["experiment_defaults"] == {"inputs": {"F": "F"}, "outputs": {"y": "y"}}
        assert main(CHECK) == 0


@pytest.mark.parametrize(
    ("column", "wanted", "name", "factor"),
    [
        ("speed_rpm", "rad/s", "speed", np.pi / 30.0),
        ("w_rad_s", "rad/s", "w", None),
        ("v_kmh", "m/s", "v", 1.0 / 3.6),
        ("T_degC", "K", "T", 1.0),
        ("T_C", "K", "T", 1.0),
        ("x_m", "m", "x", None),
        ("q_l_min", "m3/s", "q", 1e-3 / 60.0),
        ("speed_rpm", "", "speed", None),
        ("u_m", "V", "", None),
        ("u_m", "", "", None),
        ("T_min", "", "", None),
        ("_rpm", "rad/s", "", None),
        ("rpm", "rad/s", "", None),
    ],
)
def test_only_what_can_be_a_unit_is_one(written, tmp_path, column, wanted, name, factor):
    """Where it is none, the column is at most similar to the variable."""
    variable = name or column.strip("_").split("_")[0]
    variable = "speed" if variable == "rpm" else variable
    unit = {"unit": wanted} if wanted else {}
    fmu = write_fmu(tmp_path, real(variable, "input", start=0, **unit), real("y", "output"))
    path = table(tmp_path / "a.parquet", {"time": TIMES, column: FORCE, "y": FORCE})
    _, tree, _ = written(path, fmu=fmu)
    found = tree["experiments"][0].get("inputs", {})
    assert (found == {variable: column}) == bool(name)
    if name:
        assert factors(tree).get(column) == pytest.approx(factor)


class TestColumnsThatAreGiven:
    def test_a_variable_gets_the_column_that_it_is_given(self, written, tmp_path):
        columns = {"Zeit [ms]": TIMES * 1e3, "Voltage (kN)": FORCE, "y": FORCE, "pos": FORCE}
        given = ("F=Voltage (kN)", "y=pos", "time=Zeit [ms]")
        _, tree, said = written(table(tmp_path / "a.parquet", columns), given=given)
        assert "fill in" not in said
        (experiment,) = tree["experiments"]
        assert experiment["time"] == "Zeit [ms]"
        assert experiment["inputs"] == {"F": "Voltage (kN)"}
        assert experiment["outputs"] == {"y": "pos"}
        assert factors(tree) == {"Voltage (kN)": 1e3, "Zeit [ms]": 1e-3}
        assert main(CHECK) == 0

    @pytest.mark.parametrize(
        ("given", "pattern"),
        [
            (["F=Voltage"], r"map F: a.csv has no column 'Voltage'.*'Voltage \(V\)'.*'time'"),
            (["f=Voltage (V)"], "map f: .*no variable 'f'.*'F'"),
            (["m=y"], "map m: .*an input or a computed variable of mass_spring_damper.fmu"),
            (["F"], "map: .*VARIABLE=COLUMN.*'F'; write it as in --map u='Voltage"),
            (["F=y", "F=time"], "map: F .*one column.*'y' and 'time'"),
            (["F=words"], "map F: column 'words' of a.csv .*numbers"),
        ],
    )
    def test_what_is_not_there_is_said_with_what_is(self, tmp_path, refused, given, pattern):
        rows = "time,Voltage (V),y,words\n0,1,2,a\n1,1,2,b\n"
        (tmp_path / "a.csv").write_text(rows, encoding="utf-8")
        maps = [text for each in given for text in ("--map", each)]
        refused(["init", str(FMU), "a.csv", *maps], f"--{pattern}")


def test_an_input_that_jumps_keeps_each_sample(written, tmp_path):
    """Also where its name must be confirmed; what is measured is compared as it is."""
    text, tree, _ = written(table(tmp_path / "a.csv", time=TIMES, F=STEP, y=STEP))
    assert tree["experiments"][0]["inputs"]["F"] == {"column": "F", "interpolation": "hold"}
    assert tree["experiments"][0]["outputs"]["y"] == "y"
    assert 'it jumps; a fit reports if the data prefer "linear"' in text
    text, _, said = written(
        table(tmp_path / "b.csv", time=TIMES, force=STEP, position=FORCE), out="second.toml"
    )
    held = 'inputs.F = { column = "FILL IN: force?", interpolation = "hold" }'
    assert f"\n{held}  # " in text
    assert f"fill in {held}" in said


@pytest.mark.parametrize("long", [False, True])
def test_an_input_that_is_recorded_only_when_it_changes_is_held(written, tmp_path, long):
    """In all files, if one of them shows it; the cells of a joined table are empty between."""
    for name, rows in (("a", [0, 4, 11, 15, 24, 31, 36, 47]), ("b", [0, 9, 30])):
        values = dict(zip(rows, [0.0, 3.0, -2.0, 5.0, 1.0, -4.0, 2.5, 0.5], strict=False))
        if long:
            named = [(t, "y", f) for t, f in zip(TIMES, FORCE, strict=True)]
            named += [(TIMES[row], "F", value) for row, value in values.items()]
            columns = zip(*sorted(named), strict=True)
            table(tmp_path / f"{name}.csv", zip_named(columns))
        else:
            force = [values.get(row, "") for row in range(len(TIMES))]
            table(tmp_path / f"{name}.csv", time=TIMES, F=force, y=FORCE)
    text, _, _ = written("a.csv", "b.csv")
    assert "it seems to be recorded only when it changes; a fit reports" in text
    for run in ce.read_problem("first.toml").experiments:
        assert run.inputs[0].interpolation == "hold"


def zip_named(columns):
    """The columns of a long table."""
    return dict(zip(("time", "signal", "value"), columns, strict=True))


def test_a_slowly_sampled_input_is_joined_by_lines_and_that_is_said(written, tmp_path):
    cells = [FORCE[row] if row % 5 == 0 else "" for row in range(len(TIMES))]
    text, tree, _ = written(table(tmp_path / "a.csv", time=TIMES, F=cells, y=FORCE))
    assert tree["experiments"][0]["inputs"]["F"] == "F"
    assert "few of its cells have a value, and straight lines join these" in text
    assert 'until the next, write { column = "F", interpolation = "hold" }' in text


def test_columns_that_nothing_uses_are_proposed_as_signals(written, tmp_path):
    columns = {"time": TIMES, "F": FORCE, "y": FORCE, "Oil temp. [degC]": FORCE, "k": FORCE}
    text, _, _ = written(table(tmp_path / "a.parquet", columns, on=FORCE > 0.5))
    proposed = [
        '# signals.Oil_temp = "Oil temp. [degC]"  # [degC]',
        '# signals.k_measured = "k"',
        '# signals.on = "on"',
    ]
    assert all(f"\n{line}\n" in text for line in proposed)
    for line in proposed:
        text = text.replace(line, line.removeprefix("# "))
    Path("first.toml").write_text(text, encoding="utf-8")
    (run,) = ce.read_problem("first.toml").experiments
    assert [s.variable for s in run.signals] == ["Oil_temp", "k_measured", "on"]
    assert run.signals[2].values.max() == 1.0


@pytest.fixture
def accepted(written, tmp_path):
    """The problem of what init writes where all columns are called as in the FMU."""

    def call(fmu):
        description = describe(fmu.name, fmu.read_bytes())
        kinds = ("real", "integer", "boolean")
        names = [v.name for v in description.inputs() if v.kind in kinds]
        names += [n for n in description.outputs if n not in names]
        columns = {"time": TIMES} | {name: np.ones(len(TIMES)) for name in names}
        _, _, said = written(table(tmp_path / "a.parquet", columns), fmu=fmu)
        assert "fill in" not in said
        return ce.read_problem("first.toml")

    return call


@pytest.mark.parametrize(
    "fmu", sorted((ROOT / "configs" / "models").glob("*.fmu")), ids=lambda p: p.stem
)
def test_every_example_has_a_config_that_can_be_fitted(fmu, accepted):
    problem = accepted(fmu)
    assert 1 <= len(problem.parameters) <= 6
    assert not any(p.fixed or p.expression for p in problem.parameters)


@pytest.mark.parametrize(
    ("name", "version"),
    thinned(
        [(name, fmi) for name in ("types", "fixed_step", "bouncing_ball") for fmi in (3, 2)],
        lambda name, fmi: name,
        lambda name, fmi: fmi,
    ),
)
def test_fmus_of_other_kinds_too(own_fmu, accepted, name, version):
    accepted(own_fmu(name, version))


def test_several_outputs_are_weighted_by_their_noise(written, tmp_path):
    generator = np.random.default_rng(1)
    times = np.arange(2000) * 0.01
    y, v = np.sin(times), 50.0 * np.cos(times)
    columns = {
        "time": times,
        "F": y,
        "y [mm]": y * 1e3 + 5.0 * generator.normal(size=2000),
        "v": v + 2.0 * generator.normal(size=2000) + 100.0 * (times > 5.0),
    }
    _, tree, _ = written(table(tmp_path / "a.parquet", columns))
    sigma = tree["experiments"][0]["sigma"]
    assert sigma == pytest.approx({"y": 0.005, "v": 2.0}, rel=0.1)


@pytest.mark.parametrize("disturbed", ["saturated", "at rest", "missing", "fast"])
def test_a_guess_of_noise_is_about_right(written, tmp_path, disturbed):
    """Neither samples at a limit nor codes for missing values count as noise or as its absence."""
    times = np.arange(2000) * 0.01
    noise = 0.02 * np.random.default_rng(3).normal(size=2000)
    y = np.sin((15.0 if disturbed == "fast" else 1.0) * times) + noise
    if disturbed == "saturated":
        y = np.clip(y, -0.5, 0.5)
    elif disturbed == "at rest":
        y[300:1700] = y[300]
    elif disturbed == "missing":
        y[::9] = -9999.0
    text, _, _ = written(table(tmp_path / "a.csv", time=times, F=y, y=y))
    found = float(re.search(r"# sigma.y = (\S+)", text)[1])
    assert found == pytest.approx(0.02, rel=0.15)


@pytest.mark.parametrize(
    ("names", "factor"),
    [(("t_F", "t_y"), None), (("time_F [ms]", "time_y [ms]"), 0.001), (("F time", "y time"), None)],
)
def test_signals_with_their_own_times_get_them(written, tmp_path, names, factor):
    """The input has every tenth sample only; the table has no other times."""
    times = TIMES / (factor or 1.0)
    few = [*np.round(times[::10], 9), *[""] * 45]
    columns = {names[0]: few, "F": [*FORCE[::10], *[""] * 45]}
    columns |= {names[1]: np.round(times, 9), "y": FORCE}
    _, tree, said = written(table(tmp_path / "a.csv", columns))
    (run,) = tree["experiments"]
    assert (run["time"], run["outputs"]) == (names[1], {"y": "y"})
    assert run["inputs"] == {"F": {"column": "F", "time": names[0]}}
    assert factors(tree) == ({} if factor is None else dict.fromkeys(names, factor))
    assert f"its signals have their own times: {names[1]!r} for 'y', {names[0]!r} for 'F'" in said
    assert main(CHECK) == 0
    (read,) = ce.read_problem("first.toml").experiments
    np.testing.assert_allclose(read.inputs[0].times, TIMES[::10], atol=1e-9)
    np.testing.assert_allclose(read.outputs[0].times, TIMES, atol=1e-9)


def test_other_signals_have_the_time_of_the_rows(written, tmp_path):
    columns = {"time": TIMES, "F": FORCE, "t_v": TIMES + 0.5, "v": FORCE, "t_y": TIMES + 1.0}
    _, tree, _ = written(table(tmp_path / "a.csv", columns | {"y": FORCE}))
    (run,) = tree["experiments"]
    assert (run["time"], run["inputs"]) == ("time", {"F": "F"})
    assert run["outputs"] == {name: {"column": name, "time": f"t_{name}"} for name in "yv"}


def test_temperatures_are_not_the_times_of_other_columns(written, tmp_path):
    warm = 20.0 + np.sin(40.0 * TIMES)
    data = table(tmp_path / "a.csv", time=TIMES, F=FORCE, t_F=warm, y=FORCE, t_y=warm)
    _, tree, _ = written(data)
    (run,) = tree["experiments"]
    assert (run["time"], run["inputs"], run["outputs"]) == ("time", {"F": "F"}, {"y": "y"})


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (
            np.insert(TIMES[:-1], 7, TIMES[6]),
            "row 9: .*remove the repeated rows; check and",
        ),
        (np.floor(10.0 * TIMES), "row 3: .*give sample_time.*; check and fit refuse the table"),
        (
            np.where(np.arange(len(TIMES)) < 30, TIMES, TIMES - 0.255),
            "row 32: .*the clock was set back by about 0.255 s.*; check and fit refuse the table",
        ),
        (TIMES, ""),
    ],
)
def test_times_that_check_refuses_are_named(written, tmp_path, times, said):
    text, _, printed = written(table(tmp_path / "a.csv", time=times, F=FORCE, y=FORCE))
    if said:
        assert re.search(f"a.csv: column 'time', {said}", printed)
        named = f"# check and fit refuse these times: column 'time', {said.partition('; check')[0]}"
        assert re.search(f'{named}.*\ntime = "time"', text)
    assert ("refuse these times" in text) is bool(said)
    assert ("times must increase" in printed) is bool(said)
    assert main(CHECK) == (2 if said else 0)


def test_wrong_times_of_one_signal_of_a_long_table_are_named(written, tmp_path):
    times = np.r_[TIMES, np.where(np.arange(50) == 20, 0.1, TIMES)]
    names = np.repeat(["F", "y"], 50)
    data = table(tmp_path / "a.csv", time=times, signal=names, value=np.tile(FORCE, 2))
    text, _, printed = written(data)
    assert "the time of row 72 is wrong, 0.1: correct it" in printed
    assert "# check and fit refuse these times: column 'time', row 72" in text
    assert main(CHECK) == 2


def test_an_input_that_is_on_or_off_needs_its_value(written, tmp_path, capsys):
    """An input in newtons from a column of words."""
    words = np.where(STEP > 0.0, "Ein", "AUS")
    data = table(tmp_path / "a.csv", {"time": TIMES, "F": words, "y": FORCE})
    text, _, said = written(data)
    line = "# columns.F = { factor = 1.0 }"
    number = next(i for i, each in enumerate(text.split("\n"), 1) if each.startswith(line))
    assert f"line {number}: 'F' is on or off, which is read as 1 and 0 N; uncomment" in said
    assert main(CHECK) == 0
    found = " ".join(capsys.readouterr().out.split())
    assert "note input F 'F' is on or off, which is read as 1 and 0 N -> give columns." in found
    given = text.replace(line, line.removeprefix("# ").replace("1.0", "50.0"))
    Path("first.toml").write_text(given, encoding="utf-8")
    assert main(CHECK) == 0
    assert "on or off" not in capsys.readouterr().out
    (run,) = ce.read_problem("first.toml").experiments
    np.testing.assert_array_equal(run.inputs[0].values, 50.0 * STEP)


CODED = np.where(np.arange(50) % 9 == 4, -9999.0, FORCE)


def test_numbers_for_missing_values_are_named_and_left_out(written, tmp_path, capsys):
    files = [table(tmp_path / f"{n}.csv", time=TIMES, F=FORCE, y=CODED) for n in "ab"]
    text, tree, said = written(*files)
    assert tree["experiment_defaults"]["missing"] == [-9999]
    assert "missing = [-9999]  # a guess" in text
    assert said.count("(and 1 more tables): 'y' contains -9999, far from all other values") == 1
    assert main(CHECK) == 0
    Path("first.toml").write_text(text.replace("missing = ", "# missing = "), encoding="utf-8")
    assert main(CHECK) == 1
    assert re.search("problem +missing", capsys.readouterr().out)


@pytest.mark.parametrize("given", ["-9999", "[-9999]", "[-9999, 65535]"])
def test_numbers_for_missing_values_can_be_given(written, tmp_path, capsys, given):
    data = table(tmp_path / "a.csv", time=TIMES, F=FORCE, y=CODED)
    arguments = ["init", str(FMU), str(data), "--read", f"missing={given}", "--out", "a.toml"]
    assert main(arguments) == 0
    assert "contains" not in capsys.readouterr().out
    tree = tomllib.loads(Path("a.toml").read_text(encoding="utf-8"))
    assert tree["experiments"][0]["missing"] == [float(v) for v in given.strip("[]").split(",")]
    arguments[4] = "missing=never"
    assert main([*arguments, "--overwrite"]) == 2
    assert "--read: missing[0]: must be a number" in capsys.readouterr().err


class TestWhereSomethingIsOpen:
    def test_similar_names_must_be_confirmed(self, written, tmp_path, capsys):
        """What will be confirmed is converted already."""
        columns = {"time": TIMES, "force [kN]": FORCE, "position [mm]": FORCE}
        columns |= {"www [kN]": FORCE}
        text, tree, said = written(table(tmp_path / "a.parquet", columns))
        assert factors(tree) == {"force [kN]": 1e3, "position [mm]": 1e-3}
        assert main(CHECK) == 2
        refused = capsys.readouterr().err
        lines = text.split("\n")
        left = 'inputs.F = "FILL IN: force [kN]?"'
        number = next(i for i, line in enumerate(lines, 1) if line.startswith(left))
        assert f"first.toml, line {number}: fill in {left}" in said
        assert (
            f"line {number}: experiments['a'].inputs.F must be filled in, but is still" in refused
        )
        Path("first.toml").write_text(text.replace("FILL IN: ", "").replace('?"', '"'))
        assert main(CHECK) == 0
        assert ce.read_problem("first.toml").experiments[0].inputs[0].values.max() == 1000.0

    def test_a_table_without_a_time_asks_for_the_sample_time(self, written, tmp_path, capsys):
        path = table(tmp_path / "a.csv", index=np.arange(50.0), F=FORCE, y=FORCE)
        text, _, said = written(path)
        assert "fill in sample_time" in said
        assert '# time = "index"' in text
        assert main(["check", "first.toml"]) == 2
        assert "sample_time" in capsys.readouterr().err
        Path("first.toml").write_text(text.replace('"FILL IN: seconds between rows"', "0.02"))
        assert main(CHECK) == 0

    @pytest.mark.parametrize(
        ("names", "lines"),
        [
            (
                ["F", "v", "Www [mm]", "Zzz [Pa]", "Xxx [mm]"],
                [
                    '# outputs.y = "COLUMN"  # [m]',
                    '# columns."Www [mm]" = { factor = 0.001 }  # from mm',
                ],
            ),
            (["T", "t [degC]"], ['time = "time"', '"T"', '"t [degC]"']),
        ],
        ids=["like no variable", "a temperature beside a time"],
    )
    def test_columns_of_other_names_are_proposed(self, written, tmp_path, names, lines):
        columns = {"time": TIMES} | dict.fromkeys(names, FORCE)
        text, _, _ = written(table(tmp_path / "a.parquet", columns))
        assert [line for line in lines if line not in text] == []
        assert 'columns."Zzz [Pa]"' not in text

    @pytest.mark.parametrize("name", ["pull (kN)", "Load cell [kN]", "force [kN]"])
    def test_the_only_column_in_such_a_unit_is_taken(self, written, tmp_path, name):
        columns = {"time": TIMES, name: FORCE, "y": FORCE, "Zzz [Pa]": FORCE}
        files = [table(tmp_path / f"{n}.parquet", columns) for n in "abcdefgh"]
        text, tree, said = written(*files)
        assert tree["experiment_defaults"]["inputs"] == {"F": name}
        assert tree["experiment_defaults"]["columns"][name]["factor"] == 1000.0
        assert "fill in" not in said
        line = next(n for n, line in enumerate(text.split("\n"), 1) if "inputs.F = " in line)
        assert f"first.toml, line {line}: {name!r} was chosen for inputs.F, because it is" in said
        assert "the only column whose unit matches" in text
        assert "the only column whose unit matches" in said
        assert main(CHECK) == 0

    @pytest.mark.parametrize(
        ("columns", "variables"),
        [
            (["pull [kN]", "push [N]", "y"], {}),
            (["pull [kN]", "y"], {"G": "N"}),
            (["share [1]", "y"], {"H": "1"}),
            (["inner [kN]", "y"], {}),
        ],
        ids=["two columns", "two variables", "no unit", "called as another variable"],
    )
    def test_it_is_asked_for_where_units_do_not_decide(self, written, tmp_path, columns, variables):
        fmu = write_fmu(
            tmp_path,
            *(real(n, "input", unit=u, start=0) for n, u in ({"F": "N"} | variables).items()),
            real("inner", "local", unit="N"),
            real("y", "output"),
            real("k", "parameter", start=1.0),
        )
        given = {"time": TIMES} | dict.fromkeys(columns, FORCE)
        text, tree, said = written(table(tmp_path / "a.parquet", given), fmu=fmu)
        assert "the only column whose unit matches" not in text + said
        taken = tree["experiments"][0].get("inputs", {})
        assert all(column.startswith("FILL IN") for column in taken.values())

    @pytest.mark.parametrize(
        "name", ["Temperature", "motor temp", "T [degC]", "phi_temp", "p [bar]"]
    )
    def test_a_leftover_column_of_another_quantity_is_no_angle(self, written, tmp_path, name):
        fmu = write_fmu(
            tmp_path,
            real("F", "input", unit="N", start=0),
            real("w", "output", unit="rad/s"),
            real("phi", "output", unit="rad"),
            real("k", "parameter", start=1.0),
        )
        given = {"time": TIMES, "F": FORCE, "w": FORCE, name: FORCE}
        text, tree, said = written(table(tmp_path / "a.parquet", given), fmu=fmu)
        assert set(tree["experiments"][0]["outputs"]) == {"w"}
        assert f"phi = {name!r}" not in text
        assert "fill in" not in said

    def test_a_column_that_says_another_unit_is_a_problem(self, written, tmp_path, capsys):
        columns = {"time [ms]": TIMES, "F [N]": FORCE, "y_mm": FORCE}
        text, _, _ = written(table(tmp_path / "a.parquet", columns))
        assert main(CHECK) == 0
        kept = [line for line in text.split("\n") if not line.startswith("columns.")]
        Path("first.toml").write_text("\n".join(kept), encoding="utf-8")
        capsys.readouterr()
        assert main(CHECK) == 1
        said = " ".join(capsys.readouterr().out.split())
        assert "column 'time [ms]' is used for time, which is in s, without a conversion" in said
        assert "columns.y_mm = { factor = 0.001, offset = 0 }" in said
        assert "F [N]" not in said

    def test_a_time_that_is_text_is_named(self, written, tmp_path):
        path = tmp_path / "a.csv"
        path.write_text("time,F,y\nnoon,1,2\nlater,1,2\n", encoding="utf-8")
        text, _, _ = written(path)
        assert "# column 'time' has no numbers; remove the row of units" in text

    def test_a_time_with_two_meanings_is_asked_for(self, written, tmp_path, capsys):
        path = tmp_path / "a.csv"
        path.write_text("time,F,y\n12:00,1,2\n12:01,1,2\n", encoding="utf-8")
        assert main(["init", str(FMU), str(path)]) == 2
        said = capsys.readouterr().err
        assert 'choose one with time_format = "%H:%M" or "%M:%S"' in " ".join(said.split())
        for given, stop in (("%H:%M", 60.0), ("%M:%S", 1.0)):
            out = ["--out", "first.toml", "--overwrite", "--read", f"time_format={given}"]
            assert main(["init", str(FMU), str(path), *out]) == 0
            assert ce.read_problem("first.toml").experiments[0].stop == stop

    def test_an_input_without_any_column_keeps_its_start(self, written, tmp_path):
        path = table(tmp_path / "a.csv", time=TIMES, y=FORCE, Zzz=FORCE, Www=FORCE)
        text, tree, said = written(path)
        number = next(n for n, line in enumerate(text.split("\n"), 1) if "inputs.F" in line)
        assert re.search(f"first.toml, line {number}: no column of 'a'.*input 'F'.*start", said)
        assert "inputs" not in tree["experiments"][0]
        assert "keeps its start value 0" in text
        assert "# columns that match no variable of the FMU: Zzz, Www" in text
        assert main(CHECK) == 0


def test_columns_without_a_name_or_a_number_are_left_out(written, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,uEst,uVal,empty,words,\n0,1,2,,x,\n1,1,2,,y,\n", encoding="utf-8")
    text, _, _ = written(path)
    assert "# columns without numbers: empty, words\n" in text
    for name in ("uEst", "uVal"):
        assert f'= "{name}"' in text


@pytest.mark.parametrize(
    ("columns", "name", "description", "found"),
    [
        (["uEst", "other"], "u", "", "FILL IN: uEst?"),
        (["u_measured", "other"], "u", "", "FILL IN: u_measured?"),
        (["Motor speed", "other"], "drive.speed", "", "FILL IN: Motor speed?"),
        (["posiiton", "other"], "position", "", "FILL IN: posiiton?"),
        (["voltage", "other"], "V1", "the voltage of the pump", "FILL IN: voltage?"),
        (["T_1", "T1"], "T1", "", "T1"),
        (["T_1", "T1"], "t 1", "", "FILL IN: T_1?"),  # both fold alike
    ],
)
def test_a_similar_name_is_a_suggestion(written, tmp_path, columns, name, description, found):
    fmu = write_fmu(tmp_path, real(name, "input", start=0, description=description))
    given = {"time": TIMES} | dict.fromkeys(columns, FORCE)
    text, _, _ = written(table(tmp_path / "a.parquet", given), fmu=fmu)
    (line,) = re.findall(r"^inputs\..* = (\".*?\")", text, re.MULTILINE)
    assert line == f'"{found}"'


def test_names_of_any_kind_are_written_as_toml(written, tmp_path):
    path = tmp_path / 'a "quoted" \\ name.parquet'
    odd = {'y"]\\ [m]': FORCE, "Ä\u00a0# ümläut\n[[x]]": FORCE, "time": TIMES, "F": FORCE}
    text, tree, _ = written(table(path, odd))
    assert tree["experiments"][0]["data"] == path.name
    assert tree["experiments"][0]["outputs"] == {"y": 'y"]\\ [m]'}
    assert [line for line in text.split("\n") if line.startswith("[[x")] == []


@pytest.mark.parametrize(
    ("name", "unit", "constant"),
    [
        ("g", "m/s2", True),
        ("g", "", True),
        ("g", "cm/s2", True),
        ("g", "1/s", False),
        ("e", "V", False),
        ("e", "1", True),
        ("T_ref", "degC", True),
    ],
)
def test_a_constant_of_nature_has_its_unit(written, tmp_path, name, unit, constant):
    fmu = write_fmu(
        tmp_path,
        real(name, "parameter", unit=unit, start=2.0),
        real("k", "parameter", start=1.0),
        real("y", "output"),
    )
    text, tree, _ = written(table(tmp_path / "a.csv", time=TIMES, y=FORCE), fmu=fmu)
    assert (name in tree["parameters"]) is not constant
    assert ("named like a constant of nature" in text) is constant


def test_guesses_suit_temperatures_initial_values_and_what_a_model_may_divide_by(written, tmp_path):
    """And a specific heat is known."""
    fmu = write_fmu(
        tmp_path,
        real("room.T_start", "parameter", unit="K", start=293.15),
        real("T_wall", "parameter", unit="K", start=293.15),
        real("m", "parameter", unit="kg", min=0.0, start=2.0),
        real("share", "parameter", unit="1", min=0.0, max=1.0, start=0.5),
        real("cp", "parameter", unit="J/(kg.K)", min=0.0, start=4186.0),
        real("y", "output"),
    )
    text, tree, _ = written(table(tmp_path / "a.csv", time=TIMES, y=FORCE), fmu=fmu)
    initial = '# "room.T_start" = { start = 293.15, bounds = [243.15, 343.15], per = "experiment" }'
    assert re.search(f"^{re.escape(initial)}.*named like an initial value", text, re.MULTILINE)
    assert {name: each["bounds"] for name, each in tree["parameters"].items()} == {
        "T_wall": [243.15, 343.15],
        "m": [0.2, 20.0],
        "share": [0.0, 1.0],
    }
    assert tree["parameters"]["T_wall"]["start"] == 293.15
    assert re.search("^m = .*the FMU's min is 0", text, re.MULTILINE)
    assert re.search("^# cp = .*not estimated: a specific heat", text, re.MULTILINE)


def test_an_fmu_without_parameters_says_so(written, tmp_path):
    path = table(tmp_path / "a.csv", time=TIMES, y=FORCE)
    text, tree, _ = written(path, fmu=write_fmu(tmp_path, real("y", "output")))
    assert "declares no real parameter" in text
    assert tree["parameters"] == {}


class TestMistakes:
    @pytest.fixture(autouse=True)
    def files(self, tmp_path):
        table(tmp_path / "a.csv", time=TIMES, F=FORCE, y=FORCE)
        (tmp_path / "text.csv").write_text("a,b\nx,y\n")
        (tmp_path / "broken.parquet").write_text("no table")
        (tmp_path / "there.toml").write_text("")
        (tmp_path / "no.fmu").write_text("no archive")

    @pytest.mark.parametrize(
        ("arguments", "pattern"),
        [
            (["missing.fmu", "a.csv"], "no FMU missing.fmu; check the path"),
            (["no.fmu", "a.csv"], "no.fmu"),
            ([str(FMU), "missing.csv"], "no file missing.csv; check the path"),
            ([str(FMU), "broken.parquet"], "a readable parquet file"),
            ([str(FMU), "text.csv"], "text.csv .*columns of numbers.*none"),
            ([str(FMU), "a.csv", "./a.csv"], "a.csv .*named once.*2 times"),
            ([str(FMU), "a.csv", "--out", "there.toml"], "there.toml.* exists already"),
            ([str(FMU), "a.csv", "--out", "."], "a file, but is a folder"),
            ([str(FMU), "a.csv", "--out", "a.csv/b.toml"], "cannot be written"),
        ],
    )
    def test_each_is_a_sentence(self, refused, arguments, pattern):
        refused(["init", *arguments], pattern)

    def test_overwrite_replaces(self, tmp_path):
        there, data = tmp_path / "there.toml", tmp_path / "a.csv"
        assert main(["init", str(FMU), str(data), "--out", str(there), "--overwrite"]) == 0
        assert there.read_text().startswith("# A first config")


def test_runs_of_the_same_name_get_different_ids(written, tmp_path):
    files = []
    for folder in ("mon", "tue"):
        (tmp_path / folder).mkdir()
        files.append(table(tmp_path / folder / "run.csv", time=TIMES, F=FORCE, y=FORCE))
    _, tree, _ = written(*files)
    assert [run["id"] for run in tree["experiments"]] == ["run", "run_2"]
