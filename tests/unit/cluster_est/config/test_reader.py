"""Every key of a config, spoiled: where, what it must be, what it is, what to do."""

from __future__ import annotations

import re
import tomllib
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.spoiled import INF, NAN, REMOVED, mutate, spoiled_tree, valid_tree, write_input

from cluster_est import read_config
from cluster_est.cli.display.terminal_text import readable
from cluster_est.config.reader import parse_config
from cluster_est.errors import ClusterEstError, ConfigError
from cluster_est.toml import to_toml

A = "experiments.0"
HUGE = 16**5000  # Python refuses to write this one in decimals

UNKNOWN = [
    ("modle", "modle", "'model'"),
    ("model.fmuu", "model.fmuu", "'fmu'"),
    ("parameters.m.strat", "parameters.m.strat", "'start'"),
    (f"{A}.outptus", "experiments['a'].outptus", "'outputs'"),
    (f"{A}.columns.force.fator", "experiments['a'].columns.force.fator", "'factor'"),
    ("method.nmae", "method.nmae", "'name'"),
    ("executor.wokers", "executor.wokers", "'workers'"),
    ("budget.evals", "budget.evals", "'evaluations'"),
    ("cost.nme", "cost.nme", "'name'"),
]
MISSING = [
    ("model", "model is missing; add it (the FMU"),
    ("model.fmu", "model.fmu is missing; add it (path of the FMU"),
    ("parameters.m.start", "parameters.m.start is missing; add it (where the estimation starts"),
    ("experiments", "experiments is missing"),
    (f"{A}.id", "experiments[0].id is missing"),
    (f"{A}.data", "experiments['a'].data is missing"),
    (f"{A}.outputs", "experiments['a'].outputs is missing"),
    (f"{A}.time", "must have either time (a column) or sample_time (seconds) but has neither"),
]
WRONG = [
    ("model", 3, "model: must be a table but is 3"),
    ("model.fmu", 3, "model.fmu: must be text in quotes but is 3"),
    ("model.interface", "cosim", "'auto', 'model_exchange' or 'co_simulation' but is 'cosim'"),
    ("model.solver", "euler", "'dormand_prince', 'rk4', 'cvode' or 'fmu' but is 'euler'"),
    ("model.step", "fast", "model.step: must be a number but is 'fast'"),
    ("model.step", INF, "model.step: must be a finite number but is inf"),
    ("model.step", NAN, "must be a finite number but is nan"),
    ("model.step", 0.0, "must be greater than 0 but is 0.0"),
    ("model.rtol", 2.0, "model.rtol: must be less than 1 but is 2.0"),
    ("model.atol", INF, "model.atol: must be a finite number"),
    ("model.max_steps", 1.5, "model.max_steps: must be a whole number but is 1.5"),
    ("model.max_steps", 2**70, "must be at most 9.22337e+18 but is 1180591620717411303424"),
    ("data_folders", "x", "data_folders: must be a list but is 'x'"),
    ("data_folders", [3], "data_folders[0]: must be text in quotes but is 3"),
    ("parameters", 3, "parameters: must be a table but is 3"),
    ("parameters.m", 3, "parameters.m: must be a table but is 3"),
    ("parameters.m.start", "1.5", "must be a number but is '1.5'; remove the quotes"),
    ("parameters.m.start", True, "parameters.m.start: must be a number but is true"),
    ("parameters.m.start", NAN, "parameters.m.start: must be a finite number but is nan"),
    ("parameters.m.bounds", 3, "parameters.m.bounds: must be a list of two numbers but is 3"),
    ("parameters.m.bounds", [1.0], "bounds: must be a list of two numbers but is [1.0]"),
    ("parameters.m.bounds", [1, 2, 3], "bounds: must be a list of two numbers but is [1, 2, 3]"),
    ("parameters.m.bounds", ["0", 1], "bounds: must be a list of two numbers but is ['0', 1]"),
    ("parameters.m.scale", "ln", "must be 'linear' or 'log' but is 'ln'"),
    ("parameters.m.fixed", "true", "must be true or false but is 'true'; remove the quotes"),
    ("parameters.m.variable", 3, "parameters.m.variable: must be text in quotes"),
    ("values", 3, "values: must be a table"),
    ("values.c", NAN, "values.c: must be a finite number, true, false or a text but is nan"),
    ("experiments", [], "experiments: must have at least one entry"),
    ("experiments", {}, "experiments: must be a list but is {}; open each entry with [[exper"),
    ("experiments", [3], "experiments[0]: must be a table but is 3"),
    (f"{A}.id", "", "experiments[0].id: must not be empty"),
    (f"{A}.id", 3, "experiments[0].id: must be text in quotes but is 3"),
    (f"{A}.sample_time", 0.1, "but has both; remove one"),
    (f"{A}.sample_time", INF, "sample_time: must be a finite number but is inf"),
    (f"{A}.inputs", 3, "experiments['a'].inputs: must be a table but is 3"),
    (f"{A}.inputs.F", 3, "inputs.F: must be a column's name or { column, interpolation } but"),
    (f"{A}.inputs.F", {}, "inputs.F.column is missing; add it (column of the data)"),
    (f"{A}.inputs.F", {"column": "force", "interpolation": "cubic"}, "'linear' or 'hold' but is"),
    (f"{A}.outputs", {}, "experiments['a'].outputs is missing"),
    (f"{A}.outputs.y", 3, "experiments['a'].outputs.y: must be a column's name or"),
    (f"{A}.outputs.F", "force", "outputs.F: must not be an input of the same experiment"),
    (f"{A}.sigma", {"y": 0.0}, "experiments['a'].sigma.y: must be greater than 0 but is 0.0"),
    (f"{A}.sigma", {"y": -1.0}, "sigma.y: must be greater than 0 but is -1.0"),
    (f"{A}.sigma", {"y": INF}, "sigma.y: must be a finite number"),
    (f"{A}.sigma", {"yy": 1.0}, "sigma.yy: must be named as one of its outputs but is not; did"),
    (f"{A}.relative_sigma", {"y": 0.1}, "relative_sigma.y: must have sigma.y beside it, the noise"),
    (f"{A}.relative_sigma", {"y": -1.0}, "relative_sigma.y: must be at least 0 but is -1.0"),
    (f"{A}.relative_sigma", {"yy": 0.1}, "relative_sigma.yy: must be named as one of its outputs"),
    (f"{A}.start", NAN, "experiments['a'].start: must be a finite number"),
    (f"{A}.stop", INF, "experiments['a'].stop: must be a finite number"),
    (f"{A}.windows", [0.1, 0.2], "windows[0]: must be a list of two numbers but is 0.1"),
    (f"{A}.windows", [[0.2, 0.1]], "windows[0]: must be [from, to] with from before to but is"),
    (f"{A}.windows", [[NAN, 1.0]], "windows[0]: must be a list of two numbers that are finite"),
    (f"{A}.test_windows", [[0.2, 0.1]], "test_windows[0]: must be [from, to] with from before to"),
    (f"{A}.rows", [2, 1], "rows: must be [from, to] with from below to but is [2, 1]"),
    (f"{A}.rows", [-1, 2], "rows: must be a list of two whole numbers from 0 but is [-1, 2]"),
    (f"{A}.rows", [0.5, 2], "rows: must be a list of two whole numbers from 0"),
    (f"{A}.role", "tset", "must be 'train' or 'test' but is 'tset'"),
    (f"{A}.values", {"x": []}, "experiments['a'].values.x: must be a finite number, true, false"),
    (f"{A}.group", 3, 'group: must be a label or { KEY = "label" } but is 3'),
    (f"{A}.group", {"cell": 3}, "group.cell: must be text in quotes but is 3"),
    (f"{A}.columns", {"force": 3}, "columns.force: must be a table but is 3"),
    (f"{A}.columns", {"force": {"factor": NAN}}, "factor: must be a finite number but is nan"),
    ("cost.name", "ssee", "cost.name: there is no 'ssee'; did you mean 'sse'?"),
    ("method.name", "least_square", "there is no 'least_square'; did you mean 'least_squares'?"),
    ("method.options", 3, "method.options: must be a table but is 3"),
    ("method.seed", -1, "method.seed: must be at least 0 but is -1"),
    ("executor.name", "rya", "executor.name: there is no 'rya'; did you mean 'ray'?"),
    ("executor.workers", 0, "executor.workers: must be greater than 0 but is 0"),
    ("budget.evaluations", 0, "budget.evaluations: must be greater than 0 but is 0"),
    ("budget.seconds", NAN, "budget.seconds: must be a finite number but is nan"),
]


def refusal(changes: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as error:
        parse_config(spoiled_tree(changes), "c.toml")
    return str(error.value)


@pytest.mark.parametrize(("path", "shown", "near"), UNKNOWN)
def test_an_unknown_key_is_named_with_the_nearest_known_one(path, shown, near):
    assert refusal({path: 1.0}) == f"c.toml: unknown key {shown}; did you mean {near}?"


def test_a_key_that_stands_too_deep_is_shown_where_it_belongs():
    said = refusal({f"{A}.outputs": {"x": {"column": "x", "sigma": 0.1}}})
    assert ".outputs.x.sigma" in said
    assert said.endswith("; 'sigma' is a key of experiments['a'] itself")
    assert "itself" not in refusal({f"{A}.outputs": {"x": {"column": "x", "sgma": 0.1}}})


@pytest.mark.parametrize(("path", "sentence"), MISSING)
def test_a_missing_key_is_named_with_what_it_is_for(path, sentence):
    message = refusal({path: REMOVED})
    assert sentence in message
    assert "\n" not in message


@pytest.mark.parametrize(("path", "value", "sentence"), WRONG)
def test_a_wrong_value_is_refused_in_one_sentence(path, value, sentence):
    message = refusal({path: value})
    assert sentence in message
    assert message.startswith("c.toml: ")
    assert message.count("\n") == (1 if value == [0.1, 0.2] else 0)


@pytest.mark.parametrize("path", ["values.c", "method.seed", "model.max_steps", "model.step"])
def test_a_number_of_thousands_of_digits_is_refused(path):
    assert f"c.toml: {path}: must be" in refusal({path: HUGE})
    assert "but is a number of thousands of digits" in refusal({path: HUGE})


def test_each_problem_has_a_line():
    changes = {"model.stp": 1, "parameters.m.start": "x", "method.seed": -1}
    assert [re.split(r"[ :]+", line)[1] for line in refusal(changes).splitlines()] == [
        "unknown", "parameters.m.start", "method.seed"
    ]  # fmt: skip


def test_short_forms_are_the_long_ones():
    config = parse_config(spoiled_tree({f"{A}.group": "cell 1", f"{A}.windows": [[0, 1]]}), "")
    (experiment,) = config.experiments
    assert experiment.inputs["F"].column == "force"
    assert experiment.group == {"": "cell 1"}
    assert experiment.windows == [(0.0, 1.0)]


def test_the_resolved_config_is_the_config():
    changes = {f"{A}.windows": [[0.0, 1.0]], f"{A}.rows": [0, 3], f"{A}.group": "g", "values.n": 3}
    config = parse_config(spoiled_tree(changes), "")
    assert parse_config(tomllib.loads(to_toml(config.model_dump())), "") == config


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"[model", "must be TOML but is not: Expected ']' at the end of a table declaration"),
        (b"a = 1\na = 2\n", "Cannot overwrite a value"),
        (b"a = " + b"[" * 5000, "must be TOML but is not: maximum recursion"),
        (b"a = " + b"9" * 5000, "must be TOML but is not"),
        ("# é".encode("latin-1"), "must be text in UTF-8 but is not"),
        (b"\xff\xfea\0", "must be text in UTF-8 but is not"),
        (b"", "model is missing"),
    ],
)
def test_a_file_that_is_no_config_is_refused(tmp_path, content, sentence):
    path = tmp_path / "c.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        read_config(path)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"there is no config file .*no\.toml; check the path"):
        read_config(tmp_path / "no.toml")
    with pytest.raises(ConfigError, match=r"must be a file that can be read but cannot be \(Is a"):
        read_config(tmp_path)


def test_a_byte_order_mark_is_no_mistake(tmp_path):
    path = write_input(tmp_path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert read_config(path).experiments[0].id == "a"


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("trials", "'trials': must be key=value with dots in the key"),
        ("=3", "'=3': must be key=value"),
        ("a..b=1", "'a..b=1': must be key=value"),
        ("a\udcff=1", "must be key=value"),
        ("modle.fmu=x", "unknown key modle; did you mean 'model'?"),
        ("parameters.m.start=zz", "parameters.m.start: must be a number but is 'zz'"),
        ("parameters.m.start.x=3", "parameters.m.start.x: 'start' is a value, not a table"),
        ("experiments=3", "experiments: must be a list but is 3"),
        ("experiments.b.role=test", "experiments.b.role: there is no 'b' in that list; it has 'a'"),
        ("experiments.7.role=test", "experiments.7.role: there is no '7' in that list"),
        ("experiments.0=3", "experiments[0]: must be a table but is 3"),
        ("parameters.m.bounds.2=3", "parameters.m.bounds.2: there is no '2' in that list"),
        ("parameters.m.bounds.x=3", "parameters.m.bounds.x: there is no 'x' in that list"),
        ("parameters.m.bounds.0.0=3", "parameters.m.bounds.0.0: '0' is a value, not a table"),
        ("method.seed=" + "[" * 5000, "method.seed: must be a whole number"),
        ("method.seed=" + "9" * 5000, "method.seed: must be a whole number"),
    ],
)
def test_an_override_that_leads_nowhere_is_refused(tmp_path, override, sentence):
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        read_config(write_input(tmp_path), [override])


def test_overrides_reach_into_lists_and_quoted_keys(tmp_path):
    overrides = [
        "parameters.m.bounds.0=0.5",
        "experiments.a.role=test",
        'values."body.m"=2.0',
        "values.der(x)=1",
        "model.solver=rk4",
    ]
    config = read_config(write_input(tmp_path), overrides)
    assert config.parameters["m"].bounds == (0.5, 10.0)
    assert config.experiments[0].role == "test"
    assert config.values == {"c": 0.6, "body.m": 2.0, "der(x)": 1}
    assert config.model.solver == "rk4"


def test_a_message_is_made_fit_for_a_terminal():
    assert readable("one\ntwo: ü 時") == "one\ntwo: ü 時"
    assert readable("a\x1b[1mb\u202e\x00") == "a\\x1b[1mb\\u202e\\x00"
    long = readable("first\n" + "a" * 5000 + "; mend it")
    assert len(long) < 2000
    assert long.startswith("first\naaa")
    assert long.endswith("aaa; mend it")


@settings(max_examples=200)
@given(st.data(), st.randoms(use_true_random=False))
def test_any_tree_is_parsed_or_refused_with_a_sentence(data, chance):
    tree = valid_tree()
    for _ in range(data.draw(st.integers(1, 4))):
        mutate(tree, chance, data)
    try:
        parse_config(tree, "c.toml")
    except ClusterEstError as error:
        assert str(error).startswith("c.toml: ")  # noqa: PT017
