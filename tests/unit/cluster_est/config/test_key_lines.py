"""Messages name the line of the config that they speak of."""

from __future__ import annotations

import pytest

from cluster_est.config.text.key_lines import with_lines

CONFIG = """# a comment
[model]
fmu = "tank.fmu"

[parameters]
UA = { start = 1.0, bounds = [9.0, 1.0] }
"rate.in" = { start = 2.0 }

[parameters.C]
start = 3.0

[experiment_defaults]
columns."Hot flow (kg/min)" = { factor = 60.0 }

[[experiments]]
id = "monday"
outputs = { T = "T_out" }

[[experiments]]
id = 'tuesday'
outputs.T = "T_out"
sigma = 0.1
"""


@pytest.mark.parametrize(("key", "line"), [
    ("model.fmu", 3),
    ("parameters.UA", 6),
    ("parameters.UA.bounds", 6),
    ("parameters.rate.in", 7),
    ("parameters.C", 9),
    ("parameters.C.start", 10),
    ("parameters.C.scale", 9),
    ("experiment_defaults.columns.Hot flow (kg/min)", 13),
    ("experiments['monday'].outputs.T", 17),
    ("experiments['tuesday'].outputs.T", 21),
    ("experiments['tuesday'].inputs.u", 19),
])  # fmt: skip
def test_the_line_of_a_key(tmp_path, key, line):
    path = tmp_path / "c.toml"
    path.write_text(CONFIG, encoding="utf-8")
    said = f"{path}, line {line}: {key}: must be something else"
    assert with_lines(f"{key}: must be something else", path) == said
    assert with_lines(f"{path}: {key}: must be something else", path) == said


def test_a_value_of_the_command_line_is_in_no_line(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(CONFIG, encoding="utf-8")
    said = "parameters.UA.bounds: must be other numbers"
    for key in ("parameters.UA", "parameters.UA.bounds", "parameters.UA.bounds.0"):
        assert with_lines(said, path, [key]) == said
    assert with_lines(said, path, ["parameters.C"]) == f"{path}, line 6: {said}"


def test_unknown_keys_and_several_messages(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(CONFIG, encoding="utf-8")
    said = with_lines("unknown key parameters.UA.bound; did you mean 'bounds'?\nanything", path)
    assert said == (
        f"{path}, line 6: unknown key parameters.UA.bound; did you mean 'bounds'?\nanything"
    )


@pytest.mark.parametrize("said", [
    "parameter UA is odd", "parameters.UAX: must be", "models.fmu: must be", "the model: is odd",
])  # fmt: skip
def test_what_names_no_key_stays_as_it_is(tmp_path, said):
    path = tmp_path / "c.toml"
    path.write_text(CONFIG, encoding="utf-8")
    assert with_lines(said, path) == said.replace(
        "parameters.UAX", f"{path}, line 5: parameters.UAX"
    )
    assert with_lines(said, tmp_path / "none.toml") == said
