"""What is looked at in an FMU without a config."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.described import BOTH, END, HEAD_2, packed

from cluster_est.errors import ModelError
from cluster_est.preflight import bare_problem


def variable(name: str, reference: int, causality: str, variability: str, start: str = "") -> str:
    """A real variable of FMI 2."""
    value = f'<Real start="{start}"/>' if start else "<Real/>"
    return (
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
        f'variability="{variability}">{value}</ScalarVariable>'
    )


OUTPUT = variable("y", 1, "output", "continuous")


def problem(folder: Path, *variables: str):
    text = f"{HEAD_2}{BOTH}<ModelVariables>{''.join(variables)}</ModelVariables>{END}"
    (folder / "x.fmu").write_bytes(packed(text))
    return bare_problem(folder / "x.fmu")


def test_nothing_is_set_that_is_constant_under_any_of_its_names(tmp_path):
    found = problem(
        tmp_path, OUTPUT,
        variable("k", 2, "parameter", "fixed", "1.0"),
        variable("c", 3, "parameter", "constant", "2.0"),
        variable("d", 4, "parameter", "fixed", "3.0"),
        variable("also_d", 4, "local", "constant", "3.0"),
    )  # fmt: skip
    assert [parameter.name for parameter in found.parameters] == ["k"]


def test_options_of_the_tool_are_no_parameters(tmp_path):
    found = problem(
        tmp_path, OUTPUT,
        variable("_nle_tolerance", 2, "parameter", "fixed", "1e-6"),
        variable("solver.$step", 3, "parameter", "fixed", "1e-3"),
        variable("mass_", 4, "parameter", "fixed", "1.0"),
    )  # fmt: skip
    assert [parameter.name for parameter in found.parameters] == ["mass_"]


def test_where_nothing_is_an_output_what_moves_is_looked_at(tmp_path):
    found = problem(
        tmp_path,
        variable("p", 1, "local", "continuous"),
        variable("fixed", 2, "local", "fixed", "1.0"),
        variable("u", 3, "input", "continuous", "0.0"),
    )
    assert found.experiments[0].recorded == ("p",)


def test_where_nothing_moves_that_is_said(tmp_path):
    with pytest.raises(ModelError, match="another number that changes"):
        problem(tmp_path, variable("u", 3, "input", "continuous", "0.0"))
