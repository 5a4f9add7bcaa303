"""Misuse of the Python interface ends in a sentence of this project, as that of a config does."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.problems.springs import FMU, ROOT, spring_problem

import cluster_est as ce
from cluster_est.costs import Cost
from cluster_est.costs.robust import HuberCost
from cluster_est.errors import (
    ClusterEstError,
    ConfigError,
    ModelError,
    ProblemError,
    RunFolderError,
)
from cluster_est.problem.formulas import Formula, ParameterConstraint
from workers.messages import Limits

T = np.linspace(0.0, 1.0, 5)
DRIVEN, MEASURED = ce.Input("F", T, T), ce.Output("y", T, T)
RUN = ce.Experiment("a", 0.0, 1.0, [DRIVEN], [MEASURED])
CONFIG = ROOT / "configs" / "mass_spring_damper.toml"
MASS = ce.Parameter("m", 1.0, 0.1, 10.0)
BELOW = Formula("k - 3", ("k",))


def limited(**limits):
    return ce.Resources(limits=Limits(**limits))


@pytest.fixture(scope="module")
def problem():
    return spring_problem(experiments=2, samples=40).problem


@pytest.fixture(scope="module")
def model():
    return ce.read_model(FMU, ["m"])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"start": np.nan}, "m.start: must be a finite number but is nan"),
        ({"start": "1"}, "m.start: must be a number but is '1'"),
        ({"lower": 2.0, "upper": 0.5}, "m.bounds: the lower bound must be below the upper one"),
        ({"lower": None}, "m.lower: must be a number, or infinite for no bound, but is None"),
        ({"lower": np.nan}, "m.bounds: the lower bound must be below the upper one"),
        ({"lower": 3.0}, "m.start: must lie in its bounds [3, inf] but is 1"),
        ({"scale": "logarithmic"}, "m.scale: must be 'linear' or 'log' but is 'logarithmic'"),
        ({"start": -1.0, "scale": "log"}, "m.scale: a log scale needs a positive start"),
        ({"per": 1}, 'm.per: must be "experiment" or "group:KEY" but is 1'),
        ({"variable": 1}, "m.variable: must be text but is 1"),
        ({"name": 1}, "name: must be text but is 1"),
        ({"start": 10**400}, "m.start: must be a finite number of a usual size but is 1000"),
        ({"upper": 10**400}, "m.upper: must be a number, or infinite for no bound, but is 1000"),
        ({"fixed": "no"}, "m.fixed: must be true or false but is 'no'"),
        ({"auxiliary": 1}, "m.auxiliary: must be true or false but is 1"),
    ],
)
def test_a_parameter_that_cannot_be(given, said):
    with pytest.raises(ProblemError, match=re.escape(f"parameters.{said}")):
        ce.Parameter(**{"name": "m", "start": 1.0} | given)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"model": str(FMU)}, "problem.model: must be a Model but is"),
        ({"experiments": RUN}, "problem.experiments: must be a list of Experiment but is one"),
        ({"experiments": [RUN, RUN]}, "experiment id 'a': must appear once but appears twice"),
        ({"experiments": []}, 'experiments: at least one must have role = "train"'),
        ({"parameters": {"m": 1.0}}, "problem.parameters[0]: must be a Parameter but is 'm'"),
        ({"parameters": []}, "parameters: must be those of the model"),
        ({"cost": "huber"}, "problem.cost: must be a Cost but is 'huber'; import one"),
        ({"cost": HuberCost}, "problem.cost: must be a Cost but is the class; call it: HuberCost("),
        ({"cost": HuberCost(scale=-1.0)}, "cost.options.scale: must be at least"),
    ],
)
def test_a_problem_that_cannot_be(model, change, said):
    given = {"model": model, "parameters": [MASS], "experiments": [RUN]}
    with pytest.raises(ProblemError, match=re.escape(said)):
        ce.Problem(**given | change)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("c", "k<3"), "constraint 'c'.formula: must be a Formula but is 'k<3'; make constraints"),
        ((1, BELOW), "constraint.name: must be text but is 1"),
        (("c", BELOW, "no"), "constraint 'c'.equality: must be true or false but is 'no'"),
        (("c", BELOW, False, 0), "constraint 'c'.scale: must be greater than 0 but is 0"),
    ],
)
def test_a_constraint_that_cannot_be(given, said):
    with pytest.raises(ProblemError, match=re.escape(said)):
        ParameterConstraint(*given)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ((3, ("k",)), "formula: must be text but is 3"),
        (("k", "k"), "formula.known: must be a list of text but is one alone"),
    ],
)
def test_a_formula_that_cannot_be(given, said):
    with pytest.raises(ProblemError, match=re.escape(said)):
        Formula(*given)


@pytest.mark.parametrize(
    ("experiment", "said"),
    [
        (replace(RUN, inputs=(DRIVEN, DRIVEN)), "experiment 'a'.inputs 'F': must appear once"),
        (replace(RUN, inputs=(ce.Input("force", T, T),)), "has no variable 'force'"),
        (replace(RUN, inputs=(ce.Input("k", T, T),)), "'k' must be an input of"),
        (replace(RUN, outputs=(ce.Output("q", T, T),)), "experiment 'a'.outputs: mass_spring"),
        (replace(RUN, outputs=(ce.Output("F", T, T),)), "must be a variable that mass_spring"),
        (replace(RUN, outputs=(ce.Output("k", T, T),)), "but is of causality 'parameter'"),
        (replace(RUN, values={"k": "x"}), "must be a number, because the variable is of type real"),
        (replace(RUN, values={"F": 1.0}), "must not be an input of the same experiment but is"),
    ],
)
def test_experiments_that_the_fmu_is_not_for(model, experiment, said):
    problem = ce.Problem(model, [MASS], [experiment])
    for use in (ce.fit, ce.simulate, ce.residuals):
        with pytest.raises((ProblemError, ModelError), match=re.escape(said)):
            use(problem)


FIT = [
    ({"method": "leastsquares"}, "method.name: there is no 'leastsquares'; did you mean 'least_sq"),
    ({"method": ce.LeastSquares}, "method: must be a Method but is the class; call it"),
    ({"method": 3}, "method: must be a Method but is 3; give a method or its name"),
    ({"method": ce.LeastSquares(trials=0)}, "method.options.trials: must be at least 1 but is 0"),
    ({"method": ce.LeastSquares(ftol="a")}, "method.options.ftol: must be a number but is 'a'"),
    ({"resources": "ray"}, "resources: must be a Resources but is 'ray'; write Resources('ray')"),
    ({"resources": ce.Resources("dask")}, "executor.name: there is no 'dask'; it has 'local'"),
    ({"resources": ce.Resources(3)}, "executor.name: there is no 3"),
    ({"resources": ce.Resources(workers=0)}, "executor.workers: must be greater than 0 but is 0"),
    ({"resources": ce.Resources(workers="2")}, "executor.workers: must be a whole number but is"),
    ({"resources": ce.Resources(budget=9)}, "budget: must be a Budget but is 9"),
    ({"resources": ce.Resources(budget=ce.Budget(0))}, "budget.evaluations: must be greater than"),
    ({"resources": limited(seconds="a")}, "executor.limits.seconds: must be a number but is 'a'"),
    ({"resources": limited(stall=-1)}, "executor.limits.stall: must be greater than 0 but is -1"),
    ({"resources": limited(growth=T)}, "executor.limits.growth: must be a number but is array"),
    ({"resources": limited(memory=np.nan)}, "executor.limits.memory: must be a finite number but"),
    ({"seed": -1}, "method.seed: must be at least 0 but is -1"),
    ({"seed": 0.5}, "method.seed: must be a whole number but is 0.5"),
    ({"multistart": 5}, "multistart: must be a Multistart but is 5; write Multistart(5)"),
    ({"multistart": ce.Multistart(n=0)}, "multistart.n: must be greater than 0 but is 0"),
    ({"multistart": ce.Multistart(sampler="lhs")}, "multistart.sampler: must be 'sobol', 'latin"),
    (
        {"multistart": ce.Multistart(points={"k": 1.0})},
        "multistart.points: must be a list of dicts",
    ),
    (
        {"multistart": ce.Multistart(points=3)},
        "multistart.points: must be a list of dicts but is 3",
    ),
    (
        {"multistart": ce.Multistart(points=({}, {"k": "a"}))},
        "multistart.points[1].k: must be a number but is 'a'",
    ),
    (
        {"multistart": ce.Multistart(points=({1: 2.0},))},
        "multistart.points[0]: must be text but is 1",
    ),
    ({"uncertainty": "all"}, "uncertainty: must be an UncertaintySettings but is 'all'"),
]


@pytest.mark.parametrize(("change", "said"), FIT)
def test_a_fit_that_cannot_be(problem, change, said):
    with pytest.raises(ProblemError, match=re.escape(said)):
        ce.fit(problem, **change)


@pytest.mark.parametrize("use", [ce.fit, ce.simulate, ce.residuals, ce.close_loop])
@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("first.toml", "problem: must be a Problem but is 'first.toml'; use read_problem('first.t"),
        (None, "problem: must be a Problem but is None"),
    ],
)
def test_what_is_no_problem(use, given, said):
    with pytest.raises(ProblemError, match=re.escape(said)):
        use(given)


def test_a_config_is_no_problem_yet():
    config = ce.read_config(str(ROOT / "configs" / "mass_spring_damper.toml"))
    with pytest.raises(ProblemError, match="; use build_problem"):
        ce.fit(config)


def test_values_to_simulate_at_are_those_of_unknowns(problem):
    with pytest.raises(
        ProblemError, match=r"values\.kk: must be named as an unknown of the problem"
    ):
        ce.simulate(problem, values={"kk": 1.0})
    with pytest.raises(ProblemError, match=r"values\.k: must be a number but is '1'"):
        ce.simulate(problem, values={"k": "1"})
    with pytest.raises(ProblemError, match="resources: must be a Resources but is"):
        ce.simulate(problem, {"k": 1.0})


def test_residuals_at_no_point(problem):
    with pytest.raises(ProblemError, match="must be 'forward' or 'central' but is 'fwd'"):
        ce.residuals(problem, differences="fwd")
    with (
        ce.residuals(problem) as f,
        pytest.raises(ProblemError, match="x must be a list of numbers but is 'a'"),
    ):
        f("a")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"profiles": "all"}, "profiles: must be a list of text but is one alone"),
        ({"profiles": 3}, "profiles: must be a list of text but is 3"),
        ({"profiles": (3,)}, "profiles[0]: must be text but is 3"),
        ({"profiles": ("k",), "at_once": 0}, "at_once: must be at least 1 but is 0"),
        ({"steps": 0}, "steps: must be at least 1 but is 0"),
        ({"steps": 2.5}, "steps: must be a whole number but is 2.5"),
        ({"max_steps": 1}, "max_steps: must be at least 2 but is 1"),
        ({"bootstrap": -1}, "bootstrap: must be at least 0 but is -1"),
        ({"bootstrap": True}, "bootstrap: must be a whole number but is true"),
        ({"confidence": "a"}, "confidence: must be a number but is 'a'"),
        ({"confidence": 95}, "confidence: must be at least 0.5 and below 1 but is 95"),
        ({"rise": np.nan}, "rise: must be finite"),
    ],
)
def test_intervals_that_cannot_be(given, said):
    with pytest.raises(ProblemError, match=re.escape(f"uncertainty.{said}")):
        ce.UncertaintySettings(**given)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"sites": "der(v)"}, "sites: must be a list of text but is one alone"),
        ({"forms": (1,)}, "forms[0]: must be text but is 1"),
        ({"max_effects": 1.5}, "max_effects: must be a whole number but is 1.5"),
        ({"max_effects": "a"}, "max_effects: must be a whole number but is 'a'"),
        ({"significance": "a"}, "significance: must be a number but is 'a'"),
        ({"significance": 0}, "significance: must lie between 0 and 1 but is 0"),
        ({"draws": 99}, "draws: must be at least 100 but is 99"),
        ({"pairs": "no"}, "pairs: must be true or false but is 'no'"),
        ({"thresholds": 3}, "thresholds: must be a LoopThresholds but is 3"),
    ],
)
def test_a_closed_loop_that_cannot_be(given, said):
    with pytest.raises(ProblemError, match=re.escape(f"closed_loop.{said}")):
        ce.LoopSettings(**given)


def test_what_is_no_settings_of_a_closed_loop(problem):
    with pytest.raises(ProblemError, match=r"closed_loop: must be a LoopSettings but is 'der\(v"):
        ce.close_loop(problem, settings="der(v)")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"path": "no.fmu"}, "model.fmu: no.fmu cannot be read (No such file or directory)"),
        ({"path": 3}, "model.fmu: must be a path but is 3"),
        ({"path": ROOT / "pyproject.toml"}, "must be an FMU, which is a zip file, but is not"),
        ({"parameters": ["q"]}, "model.parameters: mass_spring_damper.fmu has no variable 'q'"),
        ({"structure": 3}, "model.structure: must be a dict but is 3; write {name: value}"),
        ({"structure": {"n": "a"}}, "model.structure.n: must be a whole number but is 'a'"),
        ({"solver": "ode45"}, "model.solver: must be 'dormand_prince', 'rk4', 'cvode' or 'fmu'"),
        (
            {"solver": "fmu"},
            "model.solver: must be dormand_prince, rk4 or cvode for model_exchange",
        ),
        (
            {"interface": "me"},
            "model.interface: must be 'auto', 'model_exchange' or 'co_simulation'",
        ),
    ],
)
def test_a_model_that_cannot_be_read(given, said):
    with pytest.raises(ModelError, match=re.escape(said)):
        ce.read_model(**{"path": FMU} | given)


@pytest.mark.parametrize(
    ("read", "given", "said"),
    [
        (ce.read_config, (3,), "config: must be a path but is 3"),
        (ce.read_config, (None,), "config: must be a path but is None"),
        (ce.read_config, (CONFIG, 3), "overrides: must be a list of text but is 3"),
        (ce.read_config, (CONFIG, [3]), "overrides[0]: must be text but is 3"),
        (
            ce.read_config,
            (CONFIG, "a=b"),
            "overrides: must be a list of text but is one alone; put",
        ),
        (ce.read_problem, (3,), "config: must be a path but is 3"),
        (ce.read_problem, (CONFIG, "a=b"), "overrides: must be a list of text but is one alone"),
        (ce.read_table, (3,), "table: must be a path but is 3"),
        (ce.read_table, (None,), "table: must be a path but is None"),
        (
            ce.build_problem,
            ("a.toml", ROOT),
            "config: must be a Config but is 'a.toml'; use read_p",
        ),
        (ce.build_problem, (ce.read_config(CONFIG), 3), "base: must be a path but is 3"),
    ],
)
def test_what_cannot_be_read(read, given, said):
    with pytest.raises(ClusterEstError, match=re.escape(said)):
        read(*given)


def test_code_is_allowed_by_true_alone():
    with pytest.raises(ConfigError, match="allow_code: must be true or false but is 'no'"):
        ce.read_problem(CONFIG, allow_code="no")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"problem": "a.toml"}, "problem: must be a Problem but is 'a.toml'"),
        ({"site": 3}, "effect.site: must be text but is 3"),
        ({"form": 3}, "effect.form: must be text but is 3"),
        ({"equation": 3}, "effect.equation: must be text but is 3"),
        ({"variables": "v"}, "effect.variables: must be a list of text but is one alone"),
        ({"start": "a"}, "effect.start: must be a dict but is 'a'; write"),
        ({"start": {"k": "a"}}, "effect.start.k: must be a number but is 'a'"),
        ({"start": {1: 2.0}}, "effect.start: must be text but is 1"),
    ],
)
def test_an_effect_that_cannot_be_added(problem, given, said):
    whole = {"problem": problem, "site": "der(v)", "form": "coulomb"}
    with pytest.raises(ClusterEstError, match=re.escape(said)):
        ce.add_effect(**whole | given)


def test_what_a_result_has_not(problem, tmp_path):
    found = ce.fit(problem)
    with pytest.raises(RunFolderError, match="table: must be text but is 3"):
        found.table(3)
    with pytest.raises(ProblemError, match="experiment: must be text but is 3"):
        found.export(tmp_path / "a.fmu", experiment=3)


class TestWhatIsHarmless:
    def test_flags_and_numbers_of_numpy(self):
        assert ce.Parameter("m", np.float32(1.0), fixed=np.bool_(True)).fixed
        assert ce.UncertaintySettings(confidence=np.float32(0.5)).confidence == 0.5

    def test_lists_everywhere_and_the_name_of_a_method(self):
        force = ce.Input("F", [0, 1, 2, 3], [0, 1, 0, 1])
        measured = ce.Output("y", [1, 2, 3], [0.01, 0.05, 0.03])
        run = ce.Experiment("a", 0, 3, [force], [measured])
        found = ce.fit(ce.Problem(ce.read_model(FMU, ["m"]), [MASS], [run]), "lsqnonlin")
        assert found.success

    def test_a_method_by_name_is_the_method(self, problem):
        assert ce.fit(problem, "least_squares").x == ce.fit(problem, ce.LeastSquares()).x

    def test_options_of_a_cost_of_ones_own_are_left_to_it(self, problem):
        @dataclass(frozen=True)
        class Own(Cost):
            name = "own"
            limits: tuple[float, ...] = (1.0,)

            def weights(self, residuals, outputs):
                return None

            def value(self, residuals, outputs):
                return float(np.abs(residuals).sum())

        assert replace(problem, cost=Own()).cost.limits == (1.0,)
