"""`[experiment_defaults]`: what every experiment has unless it says otherwise."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest
from support.spoiled import ROWS, valid_tree

import cluster_est as ce
from cluster_est.config.reader import Config, parse_config
from cluster_est.config.text.overrides import override
from cluster_est.errors import ConfigError
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.sweep.matrix import SweepRun
from cluster_est.toml import to_toml

DEFAULTS = """
[experiment_defaults]
time = "t"
inputs = { F = "force" }
outputs = { y = "position", v = "speed" }
sigma = { y = 0.001, v = 0.01 }
columns = { speed = { factor = 0.1 } }
group = "bench"
"""


def parsed(experiments: str, defaults: str = DEFAULTS, *overrides: str) -> Config:
    head = tomllib.loads(to_toml({k: v for k, v in valid_tree().items() if k != "experiments"}))
    raw: dict[str, Any] = head | tomllib.loads(defaults + experiments)
    for text in overrides:
        override(raw, text)
    return parse_config(raw, "c.toml")


def refusal(experiments: str, defaults: str = DEFAULTS) -> str:
    with pytest.raises(ConfigError) as error:
        parsed(experiments, defaults)
    return str(error.value)


def test_every_experiment_has_them():
    ids = [f"e{i}" for i in range(16)]
    config = parsed("".join(f'[[experiments]]\nid = "{i}"\ndata = "{i}.csv"\n' for i in ids))
    assert [e.id for e in config.experiments] == ids
    for each in config.experiments:
        assert each.time == "t"
        assert each.inputs["F"].column == "force"
        assert {name: out.column for name, out in each.outputs.items()} == {
            "y": "position",
            "v": "speed",
        }
        assert each.sigma == {"y": 0.001, "v": 0.01}
        assert each.columns["speed"].factor == 0.1
        assert each.group == {"": "bench"}


def test_what_an_experiment_says_itself_wins():
    config = parsed(
        """
[[experiments]]
id = "a"
data = "a.csv"
sample_time = 0.1
inputs = { F = { interpolation = "hold" } }
outputs = { v = "" }
sigma = { y = 0.002 }
group = { day = "monday" }

[[experiments]]
id = "b"
data = "b.csv"
time = "seconds"
outputs = { y = { column = "place", weight = 2.0 } }
"""
    )
    a, b = config.experiments
    assert (a.time, a.sample_time) == (None, 0.1)
    assert (a.inputs["F"].column, a.inputs["F"].interpolation) == ("force", "hold")
    assert list(a.outputs) == ["y"]
    assert a.sigma == {"y": 0.002}
    assert a.columns == {}
    assert a.group == {"": "bench", "day": "monday"}
    assert b.time == "seconds"
    assert (b.outputs["y"].column, b.outputs["y"].weight) == ("place", 2.0)
    assert b.outputs["v"].column == "speed"


def test_overrides_and_sweeps_reach_both(tmp_path):
    experiments = '[[experiments]]\nid = "a"\ndata = "a.csv"\n[[experiments]]\nid = "b"\n'
    experiments += 'data = "b.csv"\n'
    changes = [
        "experiment_defaults.sigma.y=0.5",
        "experiments.b.sigma.v=0.25",
        "experiment_defaults.relative_sigma.y=0.1",
        "experiments.b.relative_sigma.y=0.2",
        "experiments.a.inputs.F.interpolation=hold",
    ]
    a, b = parsed(experiments, DEFAULTS, *changes).experiments
    assert (a.sigma, b.sigma) == ({"y": 0.5, "v": 0.01}, {"y": 0.5, "v": 0.25})
    assert (a.relative_sigma, b.relative_sigma) == ({"y": 0.1}, {"y": 0.2})
    assert (a.inputs["F"].column, a.inputs["F"].interpolation) == ("force", "hold")
    head = to_toml({k: v for k, v in valid_tree().items() if k != "experiments"})
    path = tmp_path / "c.toml"
    path.write_text(head + DEFAULTS + experiments, encoding="utf-8")
    run = SweepRun("r", path, {}, (("experiment_defaults.time", "s"), ("drop_experiments", ["a"])))
    assert [(e.id, e.time) for e in run.read().experiments] == [("b", "s")]


def test_the_run_is_that_of_a_config_without_them(tmp_path):
    (tmp_path / "a.csv").write_text(ROWS, encoding="utf-8")
    plain = valid_tree()
    (own,) = plain["experiments"]
    short = plain | {
        "experiment_defaults": {k: v for k, v in own.items() if k not in ("id", "data")},
        "experiments": [{"id": own["id"], "data": own["data"]}],
    }
    configs = [parse_config(tree, "") for tree in (plain, short)]
    assert configs[0] == configs[1]
    one, other = (
        RunIdentity.of(RunKind.FIT, c, tmp_path, ce.build_problem(c, tmp_path)) for c in configs
    )
    assert one.config_hash == other.config_hash
    assert one.config_text == other.config_text
    assert "experiment_defaults" not in one.config_text
    assert parse_config(tomllib.loads(one.config_text), "") == configs[0]


ONE = '[[experiments]]\nid = "a"\ndata = "a.csv"\n'


@pytest.mark.parametrize(
    ("experiments", "defaults", "sentence"),
    [
        (ONE, "[experiment_defaults]\ntmie = 't'\n", "unknown key experiment_defaults.tmie; did"),
        (ONE, "[experiment_defaults]\nid = 't'\n", "unknown key experiment_defaults.id"),
        (ONE, "experiment_defaults = 3\n", "experiment_defaults: must be a table but is 3"),
        (
            ONE,
            "[experiment_defaults]\nsample_time = 0.0\n",
            "experiment_defaults.sample_time: must be greater than 0 but is 0.0",
        ),
        (
            ONE,
            DEFAULTS + "[experiment_defaults.windows]\n",
            "experiment_defaults.windows: must be a list but is {}",
        ),
        (
            ONE,
            DEFAULTS.replace("v = 0.01", "vv = 0.01"),
            "experiment_defaults.sigma.vv: must be named as an output of some experiment but is "
            "not, only 'v' is; one of the two names may be wrong",
        ),
        (
            ONE,
            DEFAULTS.replace("{ speed =", "{ sped ="),
            "experiment_defaults.columns.sped: must be named as a column that some experiment "
            "uses but is not, only 'speed' is; one of the two names may be wrong",
        ),
        (ONE + "sigma.w = 1.0\n", DEFAULTS, "experiments['a'].sigma.w: must be named as one of"),
        (ONE + "inputs = 3\n", DEFAULTS, "experiments['a'].inputs: must be a table but is 3"),
        (ONE + "inputs.u = { weight = 1 }\n", DEFAULTS, "inputs.u.column is missing"),
        (ONE + "columns = 3\n", DEFAULTS, "experiments['a'].columns: must be a table but is 3"),
        ("", DEFAULTS, "experiments is missing"),
        ("experiments = 3\n", "", "experiments: must be a list but is 3"),
    ],
)
def test_mistakes_are_named_where_they_were_made(experiments, defaults, sentence):
    message = refusal(experiments, defaults)
    assert f"c.toml: {sentence}" in message or sentence in message
    assert "Traceback" not in message
