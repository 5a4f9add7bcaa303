"""`cluster-est init` writes a config that `check` accepts, or says what to fill in."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from support.problems.springs import FMU, ROOT

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.drafting import draft, write
from cluster_est.drafting.candidates import candidates
from cluster_est.drafting.columns import TableColumn, read_columns, split_suffix
from cluster_est.drafting.matching import match
from cluster_est.problem.search_space.space import make_space
from cluster_est.problem.tables.units import conversion, same_unit
from workers.fmu.description import describe
from workers.fmu.variable import ModelVariable

TIMES = np.arange(50) * 0.02
FORCE = np.sin(0.5 * np.pi * TIMES / TIMES[-1])
STEP = np.where(TIMES > 0.1, 1.0, 0.0)
TANK = ROOT / "configs" / "models" / "stirred_tank_reactor.fmu"


def table(path: Path, **columns: np.ndarray) -> Path:
    pa.csv.write_csv(pa.table(columns), path)
    return path


@pytest.fixture
def written(tmp_path, monkeypatch, capsys):
    """Runs init in a folder and gives the text, the tree, and what it printed."""
    monkeypatch.chdir(tmp_path)

    def call(*data: Path, fmu: Path = FMU, out: str = "first.toml") -> tuple[str, dict, str]:
        assert main(["init", str(fmu), *(str(d) for d in data), "--out", out]) == 0
        text = Path(out).read_text(encoding="utf-8")
        return text, tomllib.loads(text), capsys.readouterr().out

    return call


class TestWhereColumnsMatch:
    def test_the_config_passes_check_as_it_is(self, written, tmp_path, capsys):
        files = [table(tmp_path / f"{n}.csv", time=TIMES, F=FORCE, y=FORCE) for n in "abc"]
        text, tree, said = written(*files)
        assert "fill in" not in said
        assert main(["check", "first.toml", "--seconds", "0"]) == 0
        assert [e["id"] for e in tree["experiments"]] == ["a", "b", "c"]
        assert [e.get("role", "train") for e in tree["experiments"]] == ["train", "train", "test"]
        assert tree["experiment_defaults"]["inputs"] == {"F": "F"}
        assert all(set(e) <= {"id", "data", "role"} for e in tree["experiments"])
        assert tree["parameters"]["k"] == {"start": 25.0, "bounds": [2.5, 250.0]}
        assert "[N/m] stiffness of the spring" in text
        assert '# x = { start = 0.0, per = "experiment" }' in text
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
        path = tmp_path / "a.parquet"
        pq.write_table(pa.table({time: TIMES, force: FORCE, position: FORCE}), path)
        _, tree, said = written(path)
        assert "fill in" not in said
        assert main(["check", "first.toml", "--seconds", "0"]) == 0
        (experiment,) = tree["experiments"]
        assert experiment["inputs"] == {"F": force.strip()}
        assert experiment["time"] == time

    def test_paths_start_from_the_config(self, written, tmp_path):
        (tmp_path / "data").mkdir()
        path = table(tmp_path / "data" / "a.csv", time=TIMES, F=FORCE, y=FORCE)
        _, tree, _ = written(path, out="configs/first.toml")
        assert tree["experiments"][0]["data"] == "../data/a.csv"
        assert main(["check", "configs/first.toml", "--seconds", "0"]) == 0

    def test_units_that_differ_are_converted(self, written, tmp_path):
        path = tmp_path / "a.parquet"
        columns = {
            "time [ms]": TIMES * 1e3,
            "F [kN]": FORCE,
            "y [mm]": FORCE,
            "v [furlong/h]": FORCE,
        }
        pq.write_table(pa.table(columns), path)
        text, tree, _ = written(path)
        factors = {name: each["factor"] for name, each in tree["experiments"][0]["columns"].items()}
        assert factors == {"time [ms]": 1e-3, "F [kN]": 1e3, "y [mm]": 1e-3}
        assert "v [furlong/h] is in furlong/h but v is in m/s" in text
        problem = ce.read_problem("first.toml")
        assert problem.experiments[0].stop == pytest.approx(TIMES[-1])
        assert problem.experiments[0].inputs[0].values.max() == 1000.0

    def test_a_local_variable_with_a_column_of_its_name_is_compared_too(self, written, tmp_path):
        _, tree, _ = written(table(tmp_path / "a.csv", time=TIMES, F=FORCE, y=FORCE, v=FORCE))
        assert tree["experiments"][0]["outputs"] == {"y": "y", "v": "v"}


class TestWhereExperimentsAreAlike:
    def test_what_they_share_stands_once(self, written, tmp_path):
        """Sixteen tables, one line to fill in, and one guess of each output's noise."""
        files = []
        for i in range(16):
            noise = np.random.default_rng(i).normal(size=50)
            files.append(
                table(
                    tmp_path / f"run{i}.csv",
                    time=TIMES,
                    force=FORCE,
                    y=FORCE + 0.01 * noise,
                    v=FORCE + 0.02 * noise,
                )
            )
        text, tree, said = written(*files)
        assert said.count("fill in") == 1
        assert "# What every experiment has unless it says otherwise below." in text
        assert tree["experiment_defaults"]["time"] == "time"
        assert tree["experiment_defaults"]["outputs"] == {"y": "y", "v": "v"}
        sigma = tree["experiment_defaults"]["sigma"]
        assert sigma == pytest.approx({"y": 0.01, "v": 0.02}, rel=0.2)
        assert all(set(e) <= {"id", "data", "role"} for e in tree["experiments"])
        Path("first.toml").write_text(text.replace("FILL IN: force?", "force"), encoding="utf-8")
        assert main(["check", "first.toml", "--seconds", "0"]) == 0
        runs = ce.read_problem("first.toml").experiments
        assert {o.sigma for r in runs for o in r.outputs if o.variable == "y"} == {sigma["y"]}

    def test_what_differs_stays_with_each(self, written, tmp_path):
        one = table(tmp_path / "one.csv", time=TIMES, F=FORCE, y=FORCE)
        other = table(tmp_path / "other.csv", t=TIMES, F=FORCE, y=FORCE)
        _, tree, _ = written(one, other)
        assert [e["time"] for e in tree["experiments"]] == ["time", "t"]
        assert tree["experiment_defaults"] == {"inputs": {"F": "F"}, "outputs": {"y": "y"}}
        assert main(["check", "first.toml", "--seconds", "0"]) == 0


class TestUnitsAtTheEndOfNames:
    def test_they_are_split_off_and_converted(self, written, tmp_path):
        path = table(tmp_path / "a.csv", time_ms=TIMES * 1e3, F_kN=FORCE, y_mm=FORCE)
        _, tree, said = written(path)
        assert "fill in" not in said
        (experiment,) = tree["experiments"]
        assert experiment["time"] == "time_ms"
        assert experiment["inputs"] == {"F": "F_kN"}
        assert experiment["outputs"] == {"y": "y_mm"}
        factors = {name: each["factor"] for name, each in experiment["columns"].items()}
        assert factors == {"time_ms": 1e-3, "F_kN": 1e3, "y_mm": 1e-3}
        assert main(["check", "first.toml", "--seconds", "0"]) == 0

    def test_a_similar_name_has_its_unit_too(self, written, tmp_path):
        _, tree, _ = written(table(tmp_path / "a.csv", time=TIMES, force_kN=FORCE, y=FORCE))
        assert tree["experiments"][0]["inputs"] == {"F": "FILL IN: force_kN?"}
        assert tree["experiments"][0]["columns"] == {"force_kN": {"factor": 1e3}}

    def test_check_asks_for_the_conversion(self, written, tmp_path, capsys):
        text, _, _ = written(table(tmp_path / "a.csv", time=TIMES, F_kN=FORCE, y=FORCE))
        kept = [line for line in text.split("\n") if not line.startswith("columns.")]
        Path("first.toml").write_text("\n".join(kept), encoding="utf-8")
        assert main(["check", "first.toml", "--seconds", "0"]) == 1
        said = " ".join(capsys.readouterr().out.split())
        assert "column 'F_kN' is given to F, which is in N, as it is" in said
        assert 'columns."F_kN" = { factor = 1000, offset = 0 }' in said

    @pytest.mark.parametrize(
        ("column", "wanted", "found"),
        [
            ("speed_rpm", "rad/s", ("speed", "rpm")),
            ("speed_RPM", "rad/s", ("speed", "RPM")),
            ("w_rad_s", "rad/s", ("w", "rad/s")),
            ("v_m_per_s", "m/s", ("v", "m/s")),
            ("v_kmh", "m/s", ("v", "km/h")),
            ("T_degC", "K", ("T", "degC")),
            ("T_C", "K", ("T", "degC")),
            ("p_bar", "Pa", ("p", "bar")),
            ("x_m", "m", ("x", "m")),
            ("q_l_min", "m3/s", ("q", "l/min")),
            ("speed_rpm", "", ("speed", "rpm")),
            ("u_m", "V", None),
            ("u_m", "", None),
            ("T_min", "", None),
            ("u_measured", "V", None),
            ("_rpm", "rad/s", None),
            ("rpm", "rad/s", None),
        ],
    )
    def test_only_what_can_be_a_unit_is_one(self, column, wanted, found):
        assert split_suffix(column, wanted) == found


class TestColumnsThatAreGiven:
    def test_a_variable_gets_the_column_that_it_is_given(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        columns = {"Zeit [ms]": TIMES * 1e3, "Voltage (kN)": FORCE, "y": FORCE, "pos": FORCE}
        pq.write_table(pa.table(columns), tmp_path / "a.parquet")
        given = ["--map", "F=Voltage (kN)", "--map", "y=pos", "--map", "time=Zeit [ms]"]
        assert main(["init", str(FMU), "a.parquet", *given, "--out", "first.toml"]) == 0
        assert "fill in" not in capsys.readouterr().out
        text = Path("first.toml").read_text(encoding="utf-8")
        (experiment,) = tomllib.loads(text)["experiments"]
        assert experiment["time"] == "Zeit [ms]"
        assert experiment["inputs"] == {"F": "Voltage (kN)"}
        assert experiment["outputs"] == {"y": "pos"}
        assert experiment["columns"]["Voltage (kN)"] == {"factor": 1e3}
        assert experiment["columns"]["Zeit [ms]"] == {"factor": 1e-3}
        assert main(["check", "first.toml", "--seconds", "0"]) == 0

    @pytest.mark.parametrize(
        ("given", "said"),
        [
            (
                ["F=Voltage"],
                "--map F: a.csv has no column 'Voltage'; did you mean 'Voltage (V)'? Its columns "
                "are 'time', 'Voltage (V)', 'y'",
            ),
            (["f=Voltage (V)"], "has no variable 'f'; did you mean 'F'?"),
            (["m=y"], "--map m: must be an input of mass_spring_damper.fmu or something that it"),
            (["F"], "--map: must be VARIABLE=COLUMN but is 'F'; write it as in --map u='Voltage"),
            (["F=y", "F=time"], "--map: F must be given one column but is given 'y' and 'time'"),
            (["F=words"], "--map F: column 'words' of a.csv must hold numbers but does not"),
        ],
    )
    def test_what_is_not_there_is_said_with_what_is(
        self, tmp_path, monkeypatch, capsys, given, said
    ):
        monkeypatch.chdir(tmp_path)
        rows = "time,Voltage (V),y,words\n0,1,2,a\n1,1,2,b\n"
        (tmp_path / "a.csv").write_text(rows, encoding="utf-8")
        maps = [text for each in given for text in ("--map", each)]
        assert main(["init", str(FMU), "a.csv", *maps]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert "Traceback" not in error


def test_an_input_that_jumps_keeps_each_sample(written, tmp_path):
    """Also where its name must be confirmed; what is measured is compared as it is."""
    text, tree, _ = written(table(tmp_path / "a.csv", time=TIMES, F=STEP, y=STEP))
    assert tree["experiments"][0]["inputs"]["F"] == {"column": "F", "interpolation": "hold"}
    assert tree["experiments"][0]["outputs"]["y"] == "y"
    assert 'it keeps its value and jumps; "linear" if it does not' in text
    text, _, said = written(
        table(tmp_path / "b.csv", time=TIMES, force=STEP, position=FORCE), out="second.toml"
    )
    held = 'inputs.F = { column = "FILL IN: force?", interpolation = "hold" }'
    assert f"\n{held}  # " in text
    assert f"fill in {held}" in said


def test_columns_that_nothing_uses_are_proposed_as_signals(written, tmp_path):
    columns = {
        "time": TIMES,
        "F": FORCE,
        "y": FORCE,
        "Oil temp. [degC]": FORCE,
        "k": FORCE,
        "on": FORCE > 0.5,
    }
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    text, _, _ = written(tmp_path / "a.parquet")
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


def accepted(fmu: Path, folder: Path) -> ce.Problem:
    """The problem of what init writes where all columns are called as in the FMU."""
    description = describe(fmu.name, fmu.read_bytes())
    names = [v.name for v in description.inputs() if v.kind in ("real", "integer", "boolean")]
    names += [n for n in description.outputs if n not in names]
    columns = {"time": TIMES} | {name: np.ones(len(TIMES)) for name in names}
    pq.write_table(pa.table(columns), folder / "a.parquet")
    text = write(draft(fmu, [folder / "a.parquet"]), folder)
    assert text.open == ()
    (folder / "first.toml").write_text(text.toml, encoding="utf-8")
    return ce.read_problem(folder / "first.toml")


@pytest.mark.parametrize(
    "fmu", sorted((ROOT / "configs" / "models").glob("*.fmu")), ids=lambda p: p.stem
)
def test_every_example_has_a_config_that_can_be_fitted(fmu, tmp_path):
    problem = accepted(fmu, tmp_path)
    assert 1 <= len(problem.parameters) <= 6
    assert make_space(problem, (0,)).size == len(problem.parameters)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("name", ["fixed_step", "bouncing_ball", "types"])
def test_fmus_of_other_kinds_too(own_fmu, name, version, tmp_path):
    accepted(own_fmu(name, version), tmp_path)


class TestNoise:
    def test_several_outputs_are_weighted_by_their_noise(self, written, tmp_path):
        generator = np.random.default_rng(1)
        times = np.arange(2000) * 0.01
        path = tmp_path / "a.parquet"
        y, v = np.sin(times), 50.0 * np.cos(times)
        columns = {
            "time": times,
            "F": y,
            "y [mm]": y * 1e3 + 5.0 * generator.normal(size=2000),
            "v": v + 2.0 * generator.normal(size=2000) + 100.0 * (times > 5.0),
        }
        pq.write_table(pa.table(columns), path)
        _, tree, _ = written(path)
        sigma = tree["experiments"][0]["sigma"]
        assert sigma == pytest.approx({"y": 0.005, "v": 2.0}, rel=0.1)

    def test_one_output_is_left_without(self, written, tmp_path):
        text, tree, _ = written(table(tmp_path / "a.csv", time=TIMES, F=FORCE, y=FORCE))
        assert "sigma" not in tree["experiments"][0]
        assert "# sigma.y = " in text


class TestWhereSomethingIsOpen:
    def test_what_must_be_confirmed_is_converted_already(self, written, tmp_path):
        path = tmp_path / "a.parquet"
        columns = {"time": TIMES, "force [kN]": FORCE, "position [mm]": FORCE}
        pq.write_table(pa.table(columns), path)
        text, tree, _ = written(path)
        factors = {name: each["factor"] for name, each in tree["experiments"][0]["columns"].items()}
        assert factors == {"force [kN]": 1e3, "position [mm]": 1e-3}
        Path("first.toml").write_text(text.replace("FILL IN: ", "").replace('?"', '"'))
        assert ce.read_problem("first.toml").experiments[0].inputs[0].values.max() == 1000.0

    def test_similar_names_must_be_confirmed(self, written, tmp_path, capsys):
        path = table(tmp_path / "a.csv", time=TIMES, force=FORCE, position=FORCE)
        text, _, said = written(path)
        lines = text.split("\n")
        for name in ('inputs.F = "FILL IN: force?"', 'outputs.y = "FILL IN: position?"'):
            number = next(i for i, line in enumerate(lines, 1) if line.startswith(name))
            assert f"first.toml, line {number}: fill in {name}" in said
        assert main(["check", "first.toml", "--seconds", "0"]) == 2
        refused = capsys.readouterr().err
        assert "line 23: experiments['a'].inputs.F must be filled in" in refused
        assert "line 24: experiments['a'].outputs.y must be filled in but still is" in refused
        Path("first.toml").write_text(text.replace("FILL IN: ", "").replace('?"', '"'))
        assert main(["check", "first.toml", "--seconds", "0"]) == 0

    def test_a_table_without_a_time_asks_for_the_sample_time(self, written, tmp_path, capsys):
        path = table(tmp_path / "a.csv", index=np.arange(50.0), F=FORCE, y=FORCE)
        text, _, said = written(path)
        assert "fill in sample_time" in said
        assert '# time = "index"' in text
        assert main(["check", "first.toml"]) == 2
        assert "sample_time" in capsys.readouterr().err
        Path("first.toml").write_text(text.replace('"FILL IN: seconds between rows"', "0.02"))
        assert main(["check", "first.toml", "--seconds", "0"]) == 0

    def test_what_no_column_is_like_stands_there_as_a_comment(self, tmp_path):
        path = tmp_path / "a.parquet"
        columns = {"time": TIMES, "F": FORCE, "v": FORCE, "Www [mm]": FORCE, "Zzz [Pa]": FORCE}
        pq.write_table(pa.table(columns | {"Xxx [mm]": FORCE}), path)
        text = write(draft(FMU, [path]), tmp_path).toml
        assert '# outputs.y = "COLUMN"  # [m]' in text
        assert '# columns."Www [mm]" = { factor = 0.001 }  # from mm' in text
        assert 'columns."Zzz [Pa]"' not in text

    def test_the_only_column_with_a_unit_of_its_kind_must_be_confirmed(self, written, tmp_path):
        path = tmp_path / "a.parquet"
        columns = {"time": TIMES, "pull (kN)": FORCE, "y": FORCE, "Zzz [Pa]": FORCE}
        pq.write_table(pa.table(columns), path)
        text, _, said = written(path)
        assert 'inputs.F = "FILL IN: pull (kN)?"' in text
        assert 'columns."pull (kN)" = { factor = 1000.0 }' in text
        assert "fill in inputs.F" in said

    def test_a_column_that_says_another_unit_is_a_problem(self, written, tmp_path, capsys):
        path = tmp_path / "a.parquet"
        pq.write_table(pa.table({"time [ms]": TIMES, "F [N]": FORCE, "y [mm]": FORCE}), path)
        text, _, _ = written(path)
        check = ["check", "first.toml", "--seconds", "0"]
        assert main(check) == 0
        kept = [line for line in text.split("\n") if not line.startswith("columns.")]
        Path("first.toml").write_text("\n".join(kept), encoding="utf-8")
        capsys.readouterr()
        assert main(check) == 1
        said = " ".join(capsys.readouterr().out.split())
        assert "column 'time [ms]' is given to time, which is in s, as it is" in said
        assert 'columns."y [mm]" = { factor = 0.001, offset = 0 }' in said
        assert "F [N]" not in said

    def test_a_time_that_is_text_is_named(self, tmp_path):
        path = tmp_path / "a.csv"
        path.write_text("time,F,y\n12:00,1,2\n12:01,1,2\n", encoding="utf-8")
        text = write(draft(FMU, [path]), tmp_path).toml
        assert "# column 'time' holds no numbers: dates, or a row of units" in text

    def test_an_input_without_any_column_keeps_its_start(self, written, tmp_path):
        path = table(tmp_path / "a.csv", time=TIMES, y=FORCE, Zzz=FORCE, Www=FORCE)
        text, tree, said = written(path)
        number = next(n for n, line in enumerate(text.split("\n"), 1) if "inputs.F" in line)
        assert (
            f"first.toml, line {number}: no column of 'a' is like input 'F'; name one there, or it "
            "keeps its start value"
        ) in said
        assert "inputs" not in tree["experiments"][0]
        assert "keeps its start value 0" in text
        assert "# columns without a variable of the FMU: Zzz, Www" in text
        assert main(["check", "first.toml", "--seconds", "0"]) == 0


def test_columns_without_a_name_or_a_number_are_left_out(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,uEst,uVal,empty,words,\n0,1,2,,x,\n1,1,2,,y,\n", encoding="utf-8")
    found = read_columns(path)
    assert [c.name for c in found.signals] == ["uEst", "uVal"]
    assert found.unusable == ("empty", "words")


@pytest.mark.parametrize(
    ("column", "name", "description"),
    [
        ("uEst", "u", ""),
        ("u_measured", "u", ""),
        ("Motor speed", "drive.speed", ""),
        ("posiiton", "position", ""),
        ("voltage", "V1", "the voltage of the pump"),
    ],
)
def test_a_similar_name_is_a_suggestion_and_no_more(column, name, description):
    variable = ModelVariable(name, 1, "real", "input", True, description=description)
    (found,) = match(
        [variable], [TableColumn(column, column, ""), TableColumn("other", "other", "")]
    )
    assert found.column is None
    assert found.similar is not None
    assert found.similar.name == column


def test_names_that_fold_alike_are_not_told_apart():
    columns = [TableColumn(name, name, "") for name in ("T_1", "T1")]
    (found,) = match([ModelVariable("t 1", 1, "real", "input", True)], columns)
    assert found.column is None
    (found,) = match([ModelVariable("T1", 1, "real", "input", True)], columns)
    assert found.column is columns[1]


def test_names_of_any_kind_are_written_as_toml(written, tmp_path):
    path = tmp_path / 'a "quoted" \\ name.parquet'
    odd = {'y"]\\ [m]': FORCE, "Ä\u00a0# ümläut\n[[x]]": FORCE, "time": TIMES, "F": FORCE}
    pq.write_table(pa.table(odd), path)
    text, tree, _ = written(path)
    assert tree["experiments"][0]["data"] == path.name
    assert tree["experiments"][0]["outputs"] == {"y": 'y"]\\ [m]'}
    assert [line for line in text.split("\n") if line.startswith("[[x")] == []


def test_few_parameters_are_active_and_the_others_say_why():
    found = draft(TANK, [ROOT / "configs" / "data" / "mass_spring_damper" / "exp1.csv"])
    active = [c for c in found.parameters if not c.why_not]
    assert 1 <= len(active) <= 6
    assert len(found.parameters) > len(active)
    text = write(found, TANK.parent).toml
    assert all(f"not estimated: {c.why_not}" in text for c in found.parameters if c.why_not)


def test_guesses_suit_temperatures_and_initial_values():
    described = describe(FMU.name, FMU.read_bytes())
    names = ("room.T_start", "T_wall", "L")
    units = ("K", "K", "m")
    variables = {
        name: ModelVariable(name, i, "real", "parameter", True, unit=unit, start=293.15)
        for i, (name, unit) in enumerate(zip(names, units, strict=True))
    }
    found = candidates(replace(described, variables=variables))
    assert [c.per for c in found] == ["experiment", "", ""]
    assert [not c.why_not for c in found] == [False, True, True]
    assert [c.bounds for c in found] == [(243.15, 343.15)] * 2 + [(29.315, 2931.5)]


def test_what_a_model_may_divide_by_is_not_searched_at_zero_and_a_specific_heat_is_known():
    described = describe(FMU.name, FMU.read_bytes())
    given = {"m": ("kg", 2.0, None), "share": ("1", 0.5, 1.0), "cp": ("J/(kg.K)", 4186.0, None)}
    variables = {
        name: ModelVariable(
            name, i, "real", "parameter", True, unit=unit, start=start, low=0.0, high=high
        )
        for i, (name, (unit, start, high)) in enumerate(given.items())
    }
    mass, share, heat = candidates(replace(described, variables=variables))
    assert (mass.bounds, share.bounds) == ((0.2, 20.0), (0.0, 1.0))
    assert mass.origin.endswith("the FMU's min is 0")
    assert heat.why_not == "a specific heat, which is known of most substances"
    assert not mass.why_not


def test_an_fmu_without_parameters_says_so(own_fmu, tmp_path):
    path = table(tmp_path / "a.csv", time=TIMES, y=FORCE)
    found = draft(own_fmu("bouncing_ball", 2), [path])
    bare = type(found)(found.fmu, found.description, (), found.states, found.runs)
    text = write(bare, tmp_path).toml
    assert "declares no real parameter" in text
    assert tomllib.loads(text)["parameters"] == {}


class TestMistakes:
    @pytest.fixture
    def refused(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        table(tmp_path / "a.csv", time=TIMES, F=FORCE, y=FORCE)
        (tmp_path / "text.csv").write_text("a,b\nx,y\n")
        (tmp_path / "broken.parquet").write_text("no table")
        (tmp_path / "there.toml").write_text("")
        (tmp_path / "no.fmu").write_text("no archive")

        def call(*arguments: str) -> str:
            assert main(["init", *arguments]) == 2
            error = capsys.readouterr().err
            assert error.startswith("cluster-est: ")
            assert "Traceback" not in error
            return error

        return call

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (["missing.fmu", "a.csv"], "there is no FMU missing.fmu; check the path"),
            (["no.fmu", "a.csv"], "no.fmu"),
            ([str(FMU), "missing.csv"], "there is no file missing.csv; check the path"),
            ([str(FMU), "broken.parquet"], "must be a parquet file that can be read"),
            ([str(FMU), "text.csv"], "must have columns of numbers but has none"),
            ([str(FMU), "a.csv", "./a.csv"], "must be named once but is named 2 times"),
            ([str(FMU), "a.csv", "--out", "there.toml"], "is there already; choose another"),
            ([str(FMU), "a.csv", "--out", "."], "must be a file but is a folder"),
            ([str(FMU), "a.csv", "--out", "a.csv/b.toml"], "cannot be written"),
        ],
    )
    def test_each_is_a_sentence(self, refused, arguments, said):
        assert said in refused(*arguments)

    def test_overwrite_replaces(self, refused, tmp_path):
        assert main(["init", str(FMU), "a.csv", "--out", "there.toml", "--overwrite"]) == 0
        assert (tmp_path / "there.toml").read_text().startswith("# A first config")


def test_runs_of_the_same_name_get_different_ids(tmp_path):
    files = []
    for folder in ("mon", "tue"):
        (tmp_path / folder).mkdir()
        files.append(table(tmp_path / folder / "run.csv", time=TIMES, F=FORCE, y=FORCE))
    assert [run.id for run in draft(FMU, files).runs] == ["run", "run_2"]


def test_a_column_called_t_is_a_temperature_where_there_is_a_time(tmp_path):
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table({"time": TIMES, "T": FORCE, "t [degC]": FORCE}), path)
    found = read_columns(path)
    assert found.time is not None
    assert found.time.name == "time"
    assert [c.name for c in found.signals] == ["T", "t [degC]"]


@pytest.mark.parametrize(
    ("given", "wanted", "number", "expected"),
    [
        ("mm", "m", 5.0, 0.005),
        ("degC", "K", 20.0, 293.15),
        ("K", "°C", 293.15, 20.0),
        ("rpm", "rad/s", 60.0, 2.0 * np.pi),
        ("bar", "Pa", 1.5, 1.5e5),
        ("l/min", "m3/s", 60.0, 1e-3),
        ("km/h", "m/s", 36.0, 10.0),
    ],
)
def test_units_are_converted(given, wanted, number, expected):
    found = conversion(given, wanted)
    assert found is not None
    assert found.factor * number + found.offset == pytest.approx(expected)


def test_units_that_cannot_be_converted():
    assert conversion("m", "s") is None
    assert conversion("furlong", "m") is None
    assert same_unit("N*m", "N.m")
    assert same_unit("m/s^2", "m/s2")
    assert not same_unit("m", "mm")
