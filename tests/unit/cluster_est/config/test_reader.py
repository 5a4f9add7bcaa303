"""What a config means, and what overrides make of it. Mistakes: `tests/integration/config`."""

import tomllib

from support.spoiled import spoiled_tree, write_input

from cluster_est import read_config
from cluster_est.config.reader import parse_config
from cluster_est.toml import to_toml

A = "experiments.0"


def test_short_forms_are_the_long_ones(tmp_path):
    changes = {f"{A}.group": "cell 1", f"{A}.windows": [[0, 1]]}
    (experiment,) = read_config(write_input(tmp_path, changes)).experiments
    assert experiment.inputs["F"].column == "force"
    assert experiment.group == {"": "cell 1"}
    assert experiment.windows == [(0.0, 1.0)]


def test_the_resolved_config_is_the_config():
    changes = {f"{A}.windows": [[0.0, 1.0]], f"{A}.rows": [0, 3], f"{A}.group": "g", "values.n": 3}
    config = parse_config(spoiled_tree(changes), "")
    assert parse_config(tomllib.loads(to_toml(config.model_dump())), "") == config


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
