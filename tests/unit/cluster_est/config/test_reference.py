"""configs/reference.toml has every key of the code, with the code's defaults, and nothing else."""

import dataclasses
import re
import tomllib

import pytest
from pydantic import BaseModel
from support.problems.springs import ROOT

from cluster_est import LeastSquares, LoopSettings, build_problem, read_config
from cluster_est.config import experiment_keys, sections
from cluster_est.config.choices import build_resources
from cluster_est.config.reader import parse_config
from cluster_est.errors import ClusterEstError, ProblemError
from cluster_est.problem.thinning import ThinningSettings
from cluster_est.running.multistart import Multistart
from cluster_est.running.resources import Budget, LogSettings, Resources
from cluster_est.sensitivity.settings import SensitivitySettings
from cluster_est.settings import keys_of
from cluster_est.shooting.record_segments import Shooting
from cluster_est.uncertainty import UncertaintySettings

REFERENCE = ROOT / "configs" / "reference.toml"
SECTIONS = {
    "": sections.Config,
    "model": sections.ModelSection,
    "parameters.m": sections.ParameterSection,
    "maps.torque": sections.MapSection,
    "experiments": experiment_keys.ExperimentSection,
    "experiments.inputs.F": experiment_keys.InputSection,
    "experiments.outputs.y": experiment_keys.OutputSection,
    "experiments.curve": experiment_keys.CurveSection,
    "experiments.columns.force": experiment_keys.ColumnSection,
    "effects": sections.EffectSection,
    "effects.parameters.k": sections.CoefficientSection,
    "closed_loop": sections.ClosedLoopSection,
    "cost": sections.CostSection,
    "constraints": sections.ConstraintSection,
    "constraints.step_response": sections.StepSection,
    "constraints.tracking": sections.TrackingSection,
    "multistart": Multistart,
    "uncertainty": UncertaintySettings,
    "method": sections.MethodSection,
    "executor": sections.ExecutorSection,
    "thinning": ThinningSettings,
    "budget": Budget,
    "log": LogSettings,
}
SHOWN = ("slope_change", "time", "effects", "form", "data", "expression", "outputs", "start")
SHOWN += ("constraints",)
"""Keys of which the reference has to show an example: one of several is needed."""
COMMENTED_OUT = ("experiments.curve", "constraints.step_response", "constraints.tracking")
COMMENTED_OUT += ("maps.torque",)
"""Sections that stand there as comments."""


def tree(*, everything: bool) -> dict:
    """The reference, with the keys that are commented out if `everything`."""
    text = REFERENCE.read_text(encoding="utf-8")
    if everything:
        text = re.sub(r"^# (?=\w+ = .* # )|^# (?=\w+ = \S+ \()", "", text, flags=re.MULTILINE)
    return tomllib.loads(text)


def at(table: dict, path: str) -> dict:
    for part in filter(None, path.split(".")):
        table = table[part]
        table = table[0] if isinstance(table, list) else table
    return table


@pytest.mark.parametrize(("path", "section"), SECTIONS.items())
def test_every_key_stands_in_the_reference_with_its_default(path, section):
    whole = at(tree(everything=True), path)
    assert set(whole) == set(dict(keys_of(section)))
    table = whole if path in COMMENTED_OUT else at(tree(everything=False), path)
    for name, field in keys_of(section):
        if field.is_required() or isinstance(table.get(name), dict) or name in SHOWN:
            continue
        default = field.get_default(call_default_factory=True)
        if not isinstance(default, BaseModel | dict):
            shown = table.get(name)
            assert (tuple(shown) if isinstance(default, tuple) else shown) == default, name


def test_method_options_are_those_of_least_squares():
    defaults = {field.name: field.default for field in dataclasses.fields(LeastSquares)}
    assert tree(everything=False)["method"]["options"] == defaults


def test_keys_that_are_not_given_leave_the_resources_of_python():
    assert build_resources(parse_config(tree(everything=False), "reference")) == Resources()


def test_the_reference_is_a_config_that_works():
    parse_config(tree(everything=False), "reference")
    problem = build_problem(read_config(REFERENCE), REFERENCE.parent)
    names = [p.name for p in problem.parameters]
    assert names == ["m", "coulomb.k", "coulomb.width"]


WRONG = [
    (Multistart, {"n": 0}), (Multistart, {"sampler": "x"}), (Multistart, {"points": [{"k": "a"}]}),
    (UncertaintySettings, {"confidence": 1.5}), (UncertaintySettings, {"profiles": 3}),
    (LoopSettings, {"trials": 0}), (LoopSettings, {"sites": ["derv"]}), (LoopSettings, {"dras": 1}),
    (SensitivitySettings, {"groups": 1}), (SensitivitySettings, {"method": "mooris"}),
    (Budget, {"seconds": -1.0, "evaluations": 0.5}), (LogSettings, {"max_megabytes": "1"}),
    (Shooting, {}), (Shooting, {"segments": 1}),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "given"), WRONG)
def test_python_and_a_config_refuse_with_the_same_sentence(settings, given):
    keys = tree(everything=False)
    *sections, last = settings.section.split(".")
    at(keys, ".".join(sections))[last] = given
    with pytest.raises(ClusterEstError) as of_config:
        parse_config(keys, "config.toml")
    with pytest.raises(ProblemError) as of_python:
        settings(**given)
    assert str(of_python.value) == str(of_config.value).replace("config.toml: ", "")


def test_settings_take_each_key_once_and_another_name_of_it_in_python_alone():
    for given, named in (((1, 2.0, 3), {}), ((1,), {"evaluations": 2})):
        with pytest.raises(
            ProblemError, match="budget: each of evaluations, seconds must be given at most once"
        ):
            Budget(*given, **named)
    assert LoopSettings(forms=["bias"]).changed(forms=["lag"]) == LoopSettings(effects=["lag"])
    with pytest.raises(
        ProblemError, match=r"closed_loop.effects: must be a list, but is 3 \(forms"
    ):
        LoopSettings(forms=3)
    keys = tree(everything=False)
    keys["closed_loop"] = {"forms": ["bias"]}
    with pytest.raises(ClusterEstError, match=r"unknown key closed_loop\.forms"):
        parse_config(keys, "config.toml")
