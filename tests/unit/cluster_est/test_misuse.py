import os
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar

import numpy as np
import pytest
from support.problems.springs import FMU, ROOT, spring_problem

import cluster_est as ce
from cluster_est.errors import ClusterEstError, ModelError, ProblemError
from cluster_est.executors import WorkerPool
from cluster_est.methods import Method
from cluster_est.problem.costs import COSTS, Cost
from cluster_est.problem.formulas import Formula, ParameterConstraint
from workers.messages import Limits

T = np.linspace(0.0, 1.0, 5)
DRIVEN, MEASURED = ce.Input("F", T, T), ce.Output("y", T, T)
RUN = ce.Experiment("a", 0.0, 1.0, [DRIVEN], [MEASURED])
CONFIG = ROOT / "configs" / "mass_spring_damper.toml"
MASS = ce.Parameter("m", 1.0, (0.1, 10.0))
SPRINGS = spring_problem(experiments=2, samples=40).problem
MODEL = ce.read_model(FMU)
USUAL = {
    ce.Parameter: {"name": "m", "start": 1.0},
    ce.Problem: {"model": MODEL, "parameters": [MASS], "experiments": [RUN]},
    ce.fit: {"problem": SPRINGS},
    ce.close_loop: {"problem": SPRINGS},
    ce.add_effect: {"problem": SPRINGS, "site": "der(v)", "form": "coulomb"},
    ce.read_model: {"path": FMU},
    ce.read_problem: {"path": CONFIG},
}
"""Arguments that a case does not name."""


@cache
def found():
    return ce.fit(SPRINGS)


def of_resources(**given):
    return ce.fit(SPRINGS, resources=ce.Resources(**given))


def of_limits(**given):
    return of_resources(limits=Limits(**given))


def of_starts(**given):
    return ce.fit(SPRINGS, multistart=ce.Multistart(**given))


def of_a_simulation(**values):
    return ce.simulate(SPRINGS, values=values)


def of_an_export(**given):
    return ce.export(found(), "a.fmu", **given)


def of_a_table(name):
    return found().table(name)


def of_residuals(at=None, **given):
    with ce.residuals(SPRINGS, **given) as f:
        f(at)


REFUSED = [
    (ce.Parameter, {"start": np.nan}, "m.start: must be a finite number.*nan"),
    (ce.Parameter, {"start": "1"}, "m.start: must be a number.*'1'"),
    (
        ce.Parameter,
        {"start": 10**400},
        "m.start: must be a finite number that fits into a double.*1000",
    ),
    (ce.Parameter, {"start": -1.0, "scale": "log"}, "m.scale: a log scale needs a positive start"),
    (ce.Parameter, {"bounds": (2.0, 0.5)}, "m.bounds: the lower bound must be below"),
    (ce.Parameter, {"bounds": (None, 1.0)}, "m.bounds: lower must be a number, or infinite.*None"),
    (
        ce.Parameter,
        {"bounds": (np.nan, 1.0)},
        "m.bounds: the lower bound must be below the upper bound",
    ),
    (ce.Parameter, {"bounds": (3.0, np.inf)}, r"m.start: must lie within the bounds \[3, inf\].*1"),
    (ce.Parameter, {"scale": "logarithmic"}, "m.scale: must be 'linear' or 'log'.*'logarithmic'"),
    (ce.Parameter, {"per": 1}, 'm.per: must be "experiment" or "group:KEY".*1'),
    (ce.Parameter, {"variable": 1}, "m.variable: must be text.*1"),
    (ce.Parameter, {"name": 1}, "name: must be text.*1"),
    (ce.Parameter, {"fixed": "no"}, "m.fixed: must be true or false.*'no'"),
    (ce.Parameter, {"auxiliary": 1}, "m.auxiliary: must be true or false.*1"),
    (ce.Problem, {"model": str(FMU)}, "problem.model: must be a Model"),
    (
        ce.Problem,
        {"experiments": RUN},
        "problem.experiments: must be a list of Experiment.*a single one",
    ),
    (ce.Problem, {"experiments": [RUN, RUN]}, "experiment id 'a'.*must appear once.*twice"),
    (ce.Problem, {"experiments": []}, "experiments: at least one must have role = .train"),
    (ce.Problem, {"parameters": {"m": 1.0}}, r"parameters\[0\]: must be a Parameter.*'m'"),
    (
        ce.Problem,
        {"model": replace(MODEL, parameters=("k",))},
        "parameters: must be the parameters of the model",
    ),
    (ce.Problem, {"cost": 3}, 'problem.cost: must be a Cost.*3; give a cost.*"huber"'),
    (ce.Problem, {"cost": COSTS["huber"]}, r"problem.cost: must be a Cost.*class.*HuberCost\("),
    (ce.fit, {"method": "leastsquares"}, "method.name.*'leastsquares'.*did you mean 'least_sq"),
    (ce.fit, {"method": ce.LeastSquares}, "method: must be a Method.*class.*call it"),
    (ce.fit, {"method": 3}, "method: must be a Method.*3; give a method or its name"),
    (ce.fit, {"resources": "rays"}, "executor.name: there is no 'rays'.*'ray'"),
    (ce.fit, {"resources": 3}, "resources: must be a Resources.*3.*such as .processes."),
    (ce.fit, {"resources": {"limits": {"stalls": 1}}}, "executor.limits: .*'stalls'.*'stall'"),
    (ce.fit, {"resources": {"budget": {"second": 1}}}, "budget.second.*did you mean 'seconds'"),
    (ce.fit, {"seed": -1}, "method.seed: must be at least 0.*-1"),
    (ce.fit, {"seed": 0.5}, "method.seed: must be a whole number.*0.5"),
    (ce.fit, {"multistart": "five"}, "multistart.n: must be a whole number.*'five'"),
    (ce.fit, {"uncertainty": {"profile": True}}, "uncertainty.profile.*did you mean 'profiles'"),
    (of_resources, {"executor": "dask"}, "executor.name: there is no 'dask'.*'local'"),
    (of_resources, {"workers": 0}, "executor.workers: must be greater than 0.*0"),
    (of_resources, {"workers": "2"}, "executor.workers: must be a whole number"),
    (of_resources, {"budget": 9}, "budget: must be a Budget.*9"),
    (ce.Budget, {"evaluations": 0}, "budget.evaluations: must be greater than 0.*0"),
    (of_limits, {"seconds": "a"}, "executor.limits.seconds: must be a number.*'a'"),
    (of_limits, {"stall": -1}, "executor.limits.stall: must be greater than 0.*-1"),
    (of_starts, {"n": 0}, "multistart.n: must be greater than 0.*0"),
    (of_starts, {"sampler": "lhs"}, "multistart.sampler: must be 'sobol', 'latin"),
    (of_starts, {"points": 3}, "multistart.points: must be a list.*3"),
    (of_starts, {"points": ({}, {"k": "a"})}, r"points\[1\].k: must be a number.*'a'"),
    (of_starts, {"points": ({1: 2.0},)}, r"points\[0\].*: must be text.*1"),
    (ce.add_effect, {"problem": "a.toml"}, "problem: must be a Problem.*'a.toml'"),
    (ce.add_effect, {"site": 3}, "effect.site: must be text.*3"),
    (ce.add_effect, {"form": 3}, "effect.form: must be text.*3"),
    (ce.add_effect, {"equation": 3}, "effect.equation: must be text.*3"),
    (ce.add_effect, {"variables": "v"}, "effect.variables: must be a list of text.*a single one"),
    (ce.add_effect, {"start": "a"}, "effect.start: must be a dict.*'a'"),
    (ce.add_effect, {"start": {"k": "a"}}, "effect.start.k: must be a number.*'a'"),
    (ce.add_effect, {"start": {1: 2.0}}, "effect.start: must be text.*1"),
    (ce.read_model, {"path": "no.fmu"}, r"model.fmu: no.fmu cannot be read.*No such file"),
    (ce.read_model, {"path": 3}, "model.fmu: must be a path.*3"),
    (ce.read_model, {"path": ROOT / "pyproject.toml"}, "must be an FMU, which is a zip file"),
    (ce.Parameter, {"bounds": 3.0}, r"m.bounds: must be \(lower, upper\), but is 3"),
    (ce.read_model, {"structure": 3}, "model.structure: must be a dict.*3.*{name: value}"),
    (ce.read_model, {"structure": {"n": "a"}}, "model.structure.n: must be a whole number.*'a'"),
    (ce.read_model, {"solver": "ode45"}, "model.solver: must be 'dormand_prince', 'rk4', 'cvode'"),
    (ce.read_model, {"solver": "fmu"}, "model.solver: must be dormand_prince.*for model_exchange"),
    (ce.read_model, {"interface": "me"}, "model.interface: must be 'auto', 'model_exchange' or"),
    (of_a_simulation, {"kk": 1.0}, "values.kk: must be an unknown of the problem"),
    (of_a_simulation, {"k": "1"}, "values.k: must be a number.*'1'"),
    (ce.read_problem, {"allow_code": "no"}, "allow_code: must be true or false.*'no'"),
    (of_an_export, {"experiment": 3}, "experiment: must be text.*3"),
    (ce.close_loop, {"settings": {"effect": 3}}, "did you mean 'effects'"),
    (of_a_table, {"name": 3}, "table: must be text.*3"),
    (of_residuals, {"differences": "fwd"}, "must be 'forward' or 'central'.*'fwd'"),
    (of_residuals, {"at": "a"}, "x must be a list of numbers.*'a'"),
    (
        ce.UncertaintySettings,
        {"profiles": 3},
        "profiles: must be a list, but is 3",
    ),
    (ce.UncertaintySettings, {"at_once": 0}, "at_once: must be greater than 0.*0"),
    (ce.UncertaintySettings, {"steps": 0}, "steps: must be greater than 0.*0"),
    (ce.UncertaintySettings, {"max_steps": 1}, "max_steps: must be at least 2.*1"),
    (ce.UncertaintySettings, {"bootstrap": -1}, "bootstrap: must be at least 0.*-1"),
    (ce.UncertaintySettings, {"confidence": 95}, "confidence: must be less than 1.*95"),
    (ce.UncertaintySettings, {"rise": np.nan}, "rise: must be a finite number"),
    (ce.LoopSettings, {"sites": "der(v)"}, "sites: must be a list.*write .*a single value"),
    (ce.LoopSettings, {"max_effects": 1.5}, "max_effects: must be a whole number.*1.5"),
    (ce.LoopSettings, {"significance": 0}, "significance: must be greater than 0.*0"),
    (ce.LoopSettings, {"draws": 99}, "draws: must be at least 100.*99"),
    (ce.LoopSettings, {"pairs": "no"}, "pairs: must be true or false.*'no'"),
    (
        ce.LoopSettings,
        {"without": ("dropp",)},
        "without: the search has no part 'dropp'; did you mean 'drop'",
    ),
]
WHERE = {ce.UncertaintySettings: "uncertainty.", ce.LoopSettings: "closed_loop."}
BELOW = Formula("k - 3", ("k",))
POSITIONAL = [
    (ParameterConstraint, ("c", "k<3"), "constraint 'c'.formula: must be a Formula.*'k<3'"),
    (ParameterConstraint, (1, BELOW), "constraint.name: must be text.*1"),
    (ParameterConstraint, ("c", BELOW, "no"), "'c'.equality: must be true or false.*'no'"),
    (ParameterConstraint, ("c", BELOW, False, 0), "'c'.scale: must be greater than 0.*0"),
    (Formula, (3, ("k",)), "formula: must be text.*3"),
    (Formula, ("k", "k"), "formula.known: must be a list of text.*a single one"),
    (ce.fit, (ce.read_config(CONFIG),), "use build_problem"),
    (ce.simulate, (SPRINGS, {"k": 1.0}), "executor: there is no key 'k'"),
    (ce.read_config, (3,), "config: must be a path.*3"),
    (ce.read_config, (CONFIG, 3), "overrides: must be a list of text.*3"),
    (ce.read_config, (CONFIG, [3]), r"overrides\[0\]: must be text.*3"),
    (ce.read_config, (CONFIG, "a=b"), "overrides: must be a list of text.*a single one"),
    (ce.read_table, (3,), "table: must be a path.*3"),
    (ce.build_problem, ("a.toml", ROOT), "config: must be a Config.*'a.toml'.*read_p"),
    (ce.build_problem, (ce.read_config(CONFIG), 3), "base: must be a path.*3"),
]


@pytest.mark.parametrize(("use", "given", "said"), REFUSED)
def test_what_cannot_be_is_refused_in_a_sentence(use, given, said):
    expected = ModelError if use is ce.read_model else ClusterEstError
    with pytest.raises(expected, match=WHERE.get(use, "") + said):
        use(**USUAL.get(use, {}) | given)


@pytest.mark.parametrize(("use", "given", "said"), POSITIONAL)
def test_an_argument_that_cannot_be_is_refused_in_a_sentence(use, given, said):
    with pytest.raises(ClusterEstError, match=said):
        use(*given)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"inputs": (DRIVEN, DRIVEN)}, "experiment 'a'.inputs 'F': must appear once"),
        ({"inputs": (ce.Input("force", T, T),)}, "has no variable 'force'"),
        ({"inputs": (ce.Input("k", T, T),)}, "'k' must be an input of"),
        ({"outputs": (ce.Output("q", T, T),)}, "experiment 'a'.outputs: mass_spring"),
        ({"outputs": (ce.Output("F", T, T),)}, "must be a variable that mass_spring"),
        ({"outputs": (ce.Output("k", T, T),)}, "its causality is 'parameter'"),
        ({"values": {"k": "x"}}, r"must be a number \(the variable is of type real\)"),
        ({"values": {"F": 1.0}}, "must not also be an input of the same experiment"),
    ],
)
@pytest.mark.parametrize("use", [ce.fit, ce.simulate, ce.residuals])
def test_experiments_that_the_fmu_is_not_for(use, change, said):
    with pytest.raises((ProblemError, ModelError), match=said):
        use(ce.Problem(MODEL, [MASS], [replace(RUN, **change)]))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"inputs": (ce.Input("FF", T, T),)}, "experiment 'a'.inputs: .*'FF'; did you mean 'F'"),
        ({"outputs": (ce.Output("yy", T, T),)}, "experiment 'a'.outputs: .*'yy'; did you mean 'y'"),
        ({"values": {"kk": 1.0}}, "experiment 'a'.values: .*'kk'; did you mean 'k'"),
    ],
)
def test_names_are_compared_with_the_fmu_when_the_problem_is_made(change, said):
    with pytest.raises(ModelError, match=said):
        ce.Problem(MODEL, [MASS], [replace(RUN, **change)])
    with pytest.raises(ModelError, match=r"parameters\.mm: .*'mm'; did you mean 'm'"):
        ce.Problem(MODEL, [ce.Parameter("mm", 1.0)], [RUN])


@pytest.mark.parametrize("use", [ce.fit, ce.simulate, ce.residuals, ce.close_loop])
@pytest.mark.parametrize(
    ("given", "said"), [("first.toml", r".*use read_problem\('first.t"), (None, ".*None")]
)
def test_what_is_no_problem(use, given, said):
    with pytest.raises(ProblemError, match=f"problem: must be a Problem{said}"):
        use(given)


class TestWhatIsHarmless:
    def test_flags_and_numbers_of_numpy(self):
        assert ce.Parameter("m", np.float32(1.0), fixed=np.bool_(True)).fixed
        assert ce.UncertaintySettings(confidence=np.float32(0.5)).confidence == 0.5

    def test_lists_everywhere_and_the_name_of_a_method(self):
        force = ce.Input("F", [0, 1, 2, 3], [0, 1, 0, 1])
        measured = ce.Output("y", [1, 2, 3], [0.01, 0.05, 0.03])
        run = ce.Experiment("a", 0, 3, [force], [measured])
        assert ce.fit(ce.Problem(MODEL, [MASS], [run]), "lsqnonlin").success
        assert ce.fit(SPRINGS, "least_squares").x == found().x

    def test_options_of_a_cost_of_ones_own_are_left_to_it(self):
        @dataclass(frozen=True)
        class Own(Cost):
            name = "own"
            limits: tuple[float, ...] = (1.0,)

            def weights(self, residuals, outputs):
                return None

            def value(self, residuals, outputs):
                return float(np.abs(residuals).sum())

        assert replace(SPRINGS, cost=Own()).cost.limits == (1.0,)


@pytest.mark.parametrize("base", [Cost, Method, WorkerPool])
def test_a_class_with_a_name_that_would_be_an_option_is_refused(base):
    with pytest.raises(TypeError, match=r"Wrong\.name: must be .* write name: ClassVar\[str\]$"):

        class Wrong(base):
            name: str = "wrong"


def test_what_is_set_without_an_annotation_or_with_the_right_one_is_fine():
    class Right(Cost):
        name: ClassVar[str] = "right"
        reduction = "squares"
        scale: float = 1.0

    assert (Right.name, Right.reduction) == ("right", "squares")


def test_the_base_of_the_base_of_a_class_counts_too():
    class Family(Cost):
        strength: ClassVar[float]

    with pytest.raises(TypeError, match=r"strength: (typing\.)?ClassVar\[float\]$"):

        class Wrong(Family):
            strength: float = 1.0


@pytest.mark.parametrize("name", ["workers.py", "workers/__init__.py", "workers/notes.txt"])
def test_a_module_of_that_name_in_the_way_of_the_workers_is_named(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("", encoding="utf-8")
    (tmp_path / "script.py").write_text("import cluster_est\n", encoding="utf-8")
    command, env = [sys.executable, tmp_path / "script.py"], os.environ | {"PYTHONPATH": str(ROOT)}
    ended = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    if name.endswith(".txt"):  # a folder without modules stands in nobody's way
        assert ended.returncode == 0, ended.stderr
        return
    assert re.search(
        rf"ImportError: cluster_est needs .*Python finds .*{re.escape(str(tmp_path / name))}"
        " under that name first; rename it",
        ended.stderr,
    ), ended.stderr
