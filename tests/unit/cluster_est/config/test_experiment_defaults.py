"""`[experiment_defaults]`: what every experiment has unless it says otherwise."""

import tomllib

import pytest
from support.spoiled import ROWS, valid_tree

import cluster_est as ce
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
ONE = '[[experiments]]\nid = "a"\ndata = "a.csv"\n'
TWO = f'{ONE}[[experiments]]\nid = "b"\ndata = "b.csv"\n'


@pytest.fixture
def parsed(tmp_path):
    """The config with these experiments and defaults."""

    def call(experiments, defaults=DEFAULTS, *overrides):
        head = to_toml({k: v for k, v in valid_tree().items() if k != "experiments"})
        top, tables = (defaults, "") if defaults.startswith("exp") else ("", defaults)
        path = tmp_path / "c.toml"
        path.write_text(top + head + tables + experiments, encoding="utf-8")
        return ce.read_config(path, overrides)

    return call


def test_what_an_experiment_says_itself_wins(parsed):
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
    assert (b.inputs["F"].column, b.sigma) == ("force", {"y": 0.001, "v": 0.01})
    assert b.columns["speed"].factor == 0.1


def test_overrides_and_sweeps_reach_both(parsed, tmp_path):
    changes = [
        "experiment_defaults.sigma.y=0.5",
        "experiments.b.sigma.v=0.25",
        "experiment_defaults.relative_sigma.y=0.1",
        "experiments.b.relative_sigma.y=0.2",
        "experiments.a.inputs.F.interpolation=hold",
    ]
    a, b = parsed(TWO, DEFAULTS, *changes).experiments
    assert (a.sigma, b.sigma) == ({"y": 0.5, "v": 0.01}, {"y": 0.5, "v": 0.25})
    assert (a.relative_sigma, b.relative_sigma) == ({"y": 0.1}, {"y": 0.2})
    assert (a.inputs["F"].column, a.inputs["F"].interpolation) == ("force", "hold")
    swept = (("experiment_defaults.time", "s"), ("drop_experiments", ["a"]))
    run = SweepRun("r", tmp_path / "c.toml", {}, swept)
    assert [(e.id, e.time) for e in run.read().experiments] == [("b", "s")]


def test_the_run_is_that_of_a_config_without_them(tmp_path):
    """Nor do names of units, which change no number, make another run of it."""
    (tmp_path / "a.csv").write_text(ROWS, encoding="utf-8")
    plain = valid_tree()
    (own,) = plain["experiments"]
    short = plain | {
        "experiment_defaults": {k: v for k, v in own.items() if k not in ("id", "data")},
        "experiments": [{"id": own["id"], "data": own["data"]}],
    }
    named = plain | {"model": plain["model"] | {"units": {"v": "km/h"}}}
    configs, identities = [], []
    path = tmp_path / "c.toml"
    for tree in (plain, short, named):
        path.write_text(to_toml(tree), encoding="utf-8")
        config = ce.read_config(path)
        problem = ce.build_problem(config, tmp_path)
        configs.append(config)
        identities.append(RunIdentity.of(RunKind.FIT, config, tmp_path, problem))
    assert configs[0] == configs[1]
    one, other, units = identities
    assert one.config_hash == other.config_hash == units.config_hash
    assert one.config_text == other.config_text
    assert "experiment_defaults" not in one.config_text
    path.write_text(to_toml(tomllib.loads(one.config_text)), encoding="utf-8")
    assert ce.read_config(path) == configs[0]


@pytest.mark.parametrize(
    ("experiments", "defaults", "pattern"),
    [
        (ONE, "[experiment_defaults]\ntmie = 't'\n", "unknown key experiment_defaults.tmie; did"),
        (ONE, "[experiment_defaults]\nid = 't'\n", "unknown key experiment_defaults.id"),
        (ONE, "experiment_defaults = 3\n", "experiment_defaults: .*a table.*3"),
        (ONE, "[experiment_defaults]\nsample_time = 0.0\n", "sample_time: .*greater than 0.*0.0"),
        (ONE, DEFAULTS + "[experiment_defaults.windows]\n", r"windows: .*a list.*\{\}"),
        (
            ONE,
            DEFAULTS.replace("v = 0.01", "vv = 0.01"),
            "experiment_defaults.sigma.vv: .*output of at least one experiment.*'v'",
        ),
        (
            ONE,
            DEFAULTS.replace("{ speed =", "{ sped ="),
            "experiment_defaults.columns.sped: .*column that at least one experiment uses.*'speed'",
        ),
        (ONE + "sigma.w = 1.0\n", DEFAULTS, r"experiments\['a'\].sigma.w: .*one of the outputs"),
        (ONE + "inputs = 3\n", DEFAULTS, r"experiments\['a'\].inputs: .*a table.*3"),
        (ONE + "inputs.u = { weight = 1 }\n", DEFAULTS, "inputs.u.column is missing"),
        (ONE + "columns = 3\n", DEFAULTS, r"experiments\['a'\].columns: .*a table.*3"),
        ("", DEFAULTS, "experiments is missing"),
    ],
)
def test_mistakes_are_named_where_they_were_made(parsed, experiments, defaults, pattern):
    with pytest.raises(ConfigError, match=rf"c\.toml: .*{pattern}"):
        parsed(experiments, defaults)
