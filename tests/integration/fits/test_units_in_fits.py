"""A factor between an unknown that starts at 0 and what the model is given changes no finding.

However long or short a change by 1 is then: that of an effect may take hours to simulate.
"""

import tomllib
from itertools import product

import pytest
from support.problems.springs import ROOT
from support.run_folders import rows
from support.thinning import thinned

from cluster_est.cli import main
from cluster_est.toml import to_toml

FACTORS = (1e-15, 1e-9, 1e-3, 1e6, 1e12, 1e15)


def configured(name):
    text = (ROOT / "configs" / f"{name}.toml").read_text(encoding="utf-8")
    for folder in ("models", "data"):
        text = text.replace(f'"{folder}/', f'"{(ROOT / "configs" / folder).as_posix()}/')
    return tomllib.loads(text)


def first_position(factor):
    """Of each experiment, also of the one that is held out."""
    keys = configured("mass_spring_damper")
    del keys["parameters"]["x0"]
    keys["parameters"]["X"] = {"start": 0.0, "per": "experiment", "auxiliary": True}
    keys["parameters"]["x"] = {"expression": f"X * {factor!r}"}
    for experiment in keys["experiments"]:
        experiment.pop("values", None)
    return keys


def friction(factor, **more):
    equation = f"-{factor!r} * k * tanh(v / 0.01)"
    block = {"name": "rub", "site": "der(v)", "equation": equation}
    block["parameters"] = {"k": {"start": 0.0}}
    return configured("mass_with_friction") | {"effects": [block]} | more


KINDS = {
    "experiments": first_position,
    "effect": friction,
    "likelihood": lambda factor: friction(factor, cost={"name": "likelihood"}),
    "segments": lambda factor: friction(factor, method={"shooting": {"segments": 20}}),
}


@pytest.fixture(scope="module")
def estimates(tmp_path_factory):
    """Fit a kind with a factor; value and standard error of each estimate, without the factor."""

    def fitted(kind, factor):
        folder = tmp_path_factory.mktemp("units")
        (folder / "config.toml").write_text(to_toml(KINDS[kind](factor)), encoding="utf-8")
        out = ["--out", str(folder / "run"), "--no-report"]
        assert main(["fit", str(folder / "config.toml"), *out]) == 0
        units = {row["label"]: factor if row["label"][0] in "Xr" else 1.0 for row in
                 rows(folder / "run", "parameters")}  # fmt: skip
        return {
            row["label"]: (
                row["value"] * units[row["label"]],
                row["std_error"] * units[row["label"]],
            )
            for row in rows(folder / "run", "parameters")
        }

    return fitted


@pytest.fixture(scope="module")
def plain(estimates):
    return {}


@pytest.mark.parametrize(
    ("kind", "factor"),
    thinned(
        [
            pytest.param(kind, factor, marks=pytest.mark.slow if kind == "segments" else ())
            for kind, factor in product(KINDS, FACTORS)
        ],
        lambda kind, _: kind,
        lambda _, factor: factor > 1.0,
    ),
)
def test_a_factor_changes_no_finding(estimates, plain, kind, factor):
    if kind not in plain:
        plain[kind] = estimates(kind, 1.0)
    found = estimates(kind, factor)
    assert found.keys() == plain[kind].keys()
    for label, (value, error) in plain[kind].items():
        assert found[label][0] == pytest.approx(value, rel=0, abs=1e-3 * error), label
        assert found[label][1] == pytest.approx(error, rel=1e-2), label
