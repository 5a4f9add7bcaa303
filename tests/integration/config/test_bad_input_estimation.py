"""Mistakes in cost, constraints, curves, method, starts and uncertainty: a sentence, exit code 2.

Each sentence says where, what it must be, what it is and, where that is not plain, what to do.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.spoiled import REMOVED, write_input

from cluster_est.cli import main

A = "experiments.0"
FIT = ["fit", "config.toml", "--out", "out"]
CHECK = ["check", "config.toml"]
STEP = {"final": 1.0, "rise_time": 0.1, "settling_time": 0.2}
UNMEASURED = {f"{A}.{key}": REMOVED for key in ("data", "time", "inputs", "outputs")}
SOURCE = "def f(run):\n    return 0.0\n"

Changes = dict[str, Any]
Refuse = Callable[..., None]


@pytest.fixture
def refuse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Refuse:
    """Spoil the input and see that every command refuses it, in these words."""
    monkeypatch.chdir(tmp_path)

    def call(changes: Changes, *phrases: str, lines: int = 1, allow: bool = False) -> None:
        write_input(tmp_path, changes)
        before = sorted(tmp_path.rglob("*"))
        for command in (CHECK, FIT):
            code = main([*command, *(["--allow-code"] if allow else [])])
            said = capsys.readouterr()
            assert code == 2, (command, said)
            assert said.err.startswith("cluster-est: ")
            assert "Traceback" not in said.err
            assert said.err.count("\n") == lines
            assert said.out == ""
            for phrase in phrases:
                assert phrase in said.err
            assert sorted(tmp_path.rglob("*")) == before

    return call


def constraint(**keys: Any) -> Changes:
    return {"constraints": [keys]}


def on_y(**keys: Any) -> Changes:
    return constraint(signal="y", **keys)


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        ({"method.name": "lest_squares"}, ["there is no 'lest_squares'", "'least_squares'?"]),
        ({"method.name": 3}, ["method.name: must be text in quotes but is 3"]),
        ({"method.name": ""}, ["method.name: there is no ''; it has 'least_squares'"]),
        ({"method.options": 3}, ["method.options: must be a table but is 3"]),
        ({"method.options": {"trails": 3}}, ["least_squares has no such option", "'trials'?"]),
        ({"method.options": {"trials": 0}}, ["trials: must be at least 1 but is 0"]),
        ({"method.options": {"trials": 1.5}}, ["trials: must be a whole number but is 1.5"]),
        ({"method.options": {"trials": True}}, ["trials: must be a whole number but is true"]),
        ({"method.options": {"ftol": "1"}}, ["method.options.ftol: must be a number but is '1'"]),
        ({"method.options": {"ftol": float("nan")}}, ["ftol: must be finite", "but is nan"]),
        ({"method.options": {"ftol": -1e-9}}, ["ftol: must be at least 0 but is -1e-09"]),
        (
            {"method.options": {"differences": "backward"}},
            ["differences: must be one of", "'sensitivities' but is 'backward'"],
        ),
        ({"method.seed": -1}, ["method.seed: must be at least 0 but is -1"]),
        ({"method.seed": 1.5}, ["method.seed: must be a whole number but is 1.5"]),
    ],
)
def test_methods(refuse, changes, phrases):
    refuse(changes, *phrases)


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        ({"cost.name": "ssse"}, ["cost.name: there is no 'ssse'; did you mean 'sse'?"]),
        ({"cost.name": 1}, ["cost.name: must be text in quotes but is 1"]),
        ({"cost.options": {"scale": 1.0}}, ["cost.options.scale: sse has no such option"]),
        (
            {"cost": {"name": "huber", "options": {"scal": 1.0}}},
            ["cost.options.scal: huber has no such option; did you mean 'scale'?"],
        ),
        (
            {"cost": {"name": "huber", "options": {"scale": 0}}},
            ["cost.options.scale: must be at least 1e-100 but is 0"],
        ),
        (
            {"cost": {"name": "cauchy", "options": {"scale": "x"}}},
            ["cost.options.scale: must be a number but is 'x'"],
        ),
        (
            {"cost.name": "sae"},
            ["method.name: least_squares needs residuals", "cost.name is 'sae'", "choose another"],
        ),
        (
            {"cost.name": "total"},
            ["cost.name: ", "cost.function is missing; add it, or choose another cost"],
        ),
        ({"cost.time_base": "mesured"}, ["cost.time_base: must be 'measured'", "'mesured'"]),
        (
            {"cost.time_base": "simulated"},
            ["cost.step: must be given in seconds", "add it, or model.step"],
        ),
        (
            {"cost.time_base": "both"},
            ["cost.step: must be given in seconds, because the time base is 'both'"],
        ),
        ({"cost.step": 0}, ["cost.step: must be greater than 0 but is 0"]),
        (
            {"cost.time_base": "both", "cost.step": 1e-12},
            ["cost.step: must leave at most 10000000 times between 0 and 0.3 s but is 1e-12 s"],
        ),
        (
            {"cost.time_base": "both", "cost.step": 0.1, f"{A}.stop": 1e300},
            ["cost.step: must leave at most 10000000 times between 0 and 1e+300 s", "longer"],
        ),
        ({"cost.normalise": "mean"}, ["must be 'sigma', 'max' or 'range' but is 'mean'"]),
        ({"cost.weights": {"z": 1.0}}, ["cost.weights.z: must be named as an output", "has 'y'"]),
        ({"cost.weights": {"y": 0}}, ["cost.weights.y: must be greater than 0 but is 0"]),
        ({"cost.weights": {"y": "1"}}, ["must be a number but is '1'; remove the quotes"]),
        ({"cost.weights": 3}, ["cost.weights: must be a table but is 3"]),
        (
            {f"{A}.outputs.y": {"column": "position", "interpolation": "cubic"}},
            ["experiments['a'].outputs.y.interpolation: must be 'linear' or 'hold' but is 'cubic'"],
        ),
        (
            {f"{A}.outputs.y": {"column": "position", "weight": -1}},
            ["experiments['a'].outputs.y.weight: must be greater than 0 but is -1"],
        ),
        ({f"{A}.weight": 0}, ["experiments['a'].weight: must be greater than 0 but is 0"]),
        ({f"{A}.warm_up": -1}, ["experiments['a'].warm_up: must be at least 0 but is -1"]),
        ({f"{A}.warm_up": 9.0}, ["'a': must have at least one measured value", "but has none"]),
        ({f"{A}.windows": [[5, 6]]}, ["'a': must have at least one measured value"]),
    ],
)
def test_costs_and_time_bases(refuse, changes, phrases):
    refuse(changes, *phrases)


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        (constraint(), ["constraints[0]: must have one of expression, signal and function"]),
        ({"constraints": {}}, ["constraints: must be a list but is {}"]),
        (
            constraint(expression="m <= k", signal="y"),
            ["constraints[0]: must have one of", "but has expression and signal"],
        ),
        (
            constraint(expression="m <= k", upper=1.0),
            ["constraints[0].upper: must be left out beside expression", "remove one of the two"],
        ),
        (
            constraint(name="mass", expression="m <= q"),
            ["constraints[mass].expression: 'q'", "unknown variable 'q'; it has 'm', 'k'"],
        ),
        (
            constraint(expression="m"),
            ["constraints[0].expression: must be two formulas with <=, >= or =", "but is 'm'"],
        ),
        (
            constraint(expression="__import__('os').remove('a.csv') <= m"),
            ["constraints[0].expression: must be made of numbers", "__import__"],
        ),
        (
            constraint(expression="[x for x in (1,)] <= m"),
            ["constraints[0].expression: must be made of numbers"],
        ),
        (constraint(expression="m.real <= k"), ["unknown variable 'm.real'; it has 'm', 'k'"]),
        (constraint(expression="open(m) <= 1"), ["unknown function 'open'"]),
        (constraint(expression="1 <= 2"), ["must name a parameter but '1 <= 2' names none"]),
        (constraint(expression="m <= 1/0"), ["must have a finite value but '1/0' has none"]),
        (constraint(expression=5), ["constraints[0].expression: must be text in quotes but is 5"]),
    ],
)
def test_constraints_on_parameters(refuse, changes, phrases):
    refuse(changes, *phrases)


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        (constraint(signal="q", upper=1.0), ["has no variable 'q'", "'x', 'v'"]),
        (constraint(signal="m", upper=1.0), ["of causality 'parameter'", "choose an output"]),
        (constraint(signal="F", upper=1.0), ["of causality 'input'", "choose an output"]),
        (on_y(), ["constraints[0].signal: must have a limit but has none; add lower, upper"]),
        (on_y(uper=1.0), ["unknown key constraints[0].uper; did you mean 'upper'?"]),
        (on_y(upper="high"), ["must be a finite number or [[time, value], ...] but is 'high'"]),
        (on_y(upper=[[0]]), ["constraints[0].upper[0]: must be a list of two numbers but is [0]"]),
        (on_y(upper=[]), ["constraints[0].upper: must be a finite number", "but is []"]),
        (on_y(upper=float("nan")), ["constraints[0].upper: must be a finite number", "is nan"]),
        (on_y(upper=10**400), ["constraints[0].upper: must be a finite number", "but is 1000"]),
        (on_y(upper=[[1, 0], [0, 1]]), ["its times must not go back but do; sort the points"]),
        (
            on_y(upper=[[7, 1], [8, 1]]),
            ["constraints[0].upper: must limit the signal at some time from 0 to 0.3 s"],
        ),
        (on_y(upper=1, lower=2), ["constraints[0].lower: must not be above upper", "swap them"]),
        (on_y(upper=1, between=[5, 6]), ["constraints[0].between: must overlap with", "[5.0, 6"]),
        (on_y(upper=1, experiments=["b"]), ["constraints[0].experiments: there is no 'b'", "'a'"]),
        (on_y(upper=1, samples=1), ["constraints[0].samples: must be greater than 1 but is 1"]),
        (on_y(upper=1, samples=2**62), ["constraints[0].samples: must be at most 1e+07 but is 46"]),
        (on_y(upper=1, scale=0), ["constraints[0].scale: must be greater than 0 but is 0"]),
        (on_y(final=1, upper=2), ["constraints[0].final: must stand alone but upper and final"]),
        (on_y(final=1, tolerance=-1), ["constraints[0].tolerance: must be at least 0 but is -1"]),
        (on_y(upper=2, tolerance=1), ["constraints[0].tolerance: must be beside final"]),
        (
            on_y(step_response=STEP | {"rise": 120}),
            ["constraints[0].step_response.rise: must be less than 100 but is 120"],
        ),
        (
            on_y(step_response=STEP | {"rise_tme": 1}),
            ["unknown key constraints[0].step_response.rise_tme; did you mean 'rise_time'?"],
        ),
        (
            on_y(step_response=STEP | {"time": 9.0}),
            ["constraints[0].step_response: must limit the signal at some time", "move its times"],
        ),
        (on_y(step_response=3), ["constraints[0].step_response: must be a table but is 3"]),
        (
            constraint(signal="v", tracking={}),
            ["constraints[0].signal: must be measured in some experiment", "it has 'y'"],
        ),
        (on_y(tracking={"side": "left"}), ["must be 'both', 'upper' or 'lower' but is 'left'"]),
        (on_y(tracking={"relative": -1}), ["tracking.relative: must be at least 0 but is -1"]),
    ],
)
def test_constraints_on_signals(refuse, changes, phrases):
    refuse(changes, *phrases)


def test_a_signal_that_is_unknown_is_looked_for_where_it_was_written(refuse):
    refuse(constraint(signal="q", upper=1.0), "constraints[0].signal")


@pytest.mark.parametrize(
    ("keys", "phrases"),
    [
        ({}, ["final is missing", "rise_time is missing", "settling_time is missing"]),
        ({"final": 1.0}, ["rise_time is missing; add it", "settling_time is missing; add it"]),
        ({"final": 1.0, "rise_time": 0.1}, ["step_response.settling_time is missing; add it"]),
    ],
)
def test_every_missing_key_of_a_step_has_a_line(refuse, keys, phrases):
    refuse(on_y(step_response=keys), *phrases, lines=len(phrases))


@pytest.mark.parametrize(
    ("keys", "phrase"),
    [
        ({"rise_time": 0.2, "settling_time": 0.1}, "constraints[0].step_response"),
        ({"initial": 1.0}, "constraints[0].step_response"),
    ],
    ids=["settles before it has risen", "no step"],
)
def test_a_step_that_makes_no_sense(refuse, keys, phrase):
    refuse(on_y(step_response=STEP | keys), phrase)


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        ({"parameters.m": {}}, ["parameters.m.start is missing; add it"]),
        ({"parameters.m": {"expression": "2*q"}}, ["parameters.m.expression: ", "it has 'm', 'k'"]),
        (
            {"parameters.m": {"expression": "2*m"}},
            ["parameters.m.expression: must not depend on itself but does, through m"],
        ),
        (
            {"parameters.m": {"start": 1.0, "expression": "2*k"}},
            ["parameters.m.start: must be left out where there is an expression"],
        ),
        (
            {"parameters.m": {"expression": "2*k", "scale": "log"}},
            ["parameters.m.scale: must be left out where there is an expression"],
        ),
        (
            {"parameters.m": {"expression": "exec('1')"}},
            ["parameters.m.expression: ", "unknown function 'exec'"],
        ),
        (
            {"parameters.m": {"expression": "k <= 1"}},
            ["parameters.m.expression: must be a number", "remove the comparison"],
        ),
        (
            {"parameters.m": {"expression": "2*k"}, "parameters.k.fixed": True},
            ["parameters: at least one must be free"],
        ),
    ],
)
def test_derived_parameters(refuse, changes, phrases):
    refuse(changes, *phrases)


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        ({f"{A}.curve": {}}, ["experiments['a'].curve.columns is missing; add it"]),
        ({f"{A}.curve": {"columns": {}}}, ["curve.columns: must have at least one entry"]),
        ({f"{A}.curve": {"columns": {"y": "pos"}}}, ["no column 'pos'; did you mean 'position'?"]),
        (
            {f"{A}.curve": {"columns": {"y": "position"}, "tolerance": {"q": 1.0}}},
            ["curve.tolerance.q: must be named as one of its columns", "it has 'y'"],
        ),
        (
            {f"{A}.curve": {"columns": {"y": "position"}, "tolerance": {"y": -1}}},
            ["curve.tolerance.y: must be at least 0 but is -1"],
        ),
        (
            {f"{A}.curve": {"columns": {"y": "position"}, "samples": 1}},
            ["curve.samples: must be greater than 1 but is 1"],
        ),
        (
            {f"{A}.curve": {"columns": {"y": "position"}, "samples": 2**62}},
            ["curve.samples: must be at most 1e+07 but is 46"],
        ),
        ({f"{A}.data": REMOVED}, ["experiments['a'].data is missing; add it"]),
        (
            UNMEASURED | on_y(upper=1.0),
            ["experiments['a']: must have start and stop in seconds", "add both"],
        ),
    ],
)
def test_curves_and_what_is_not_measured(refuse, changes, phrases):
    refuse(changes, *phrases)


@pytest.mark.parametrize(
    ("changes", "phrase"),
    [
        ({"cost.function": "mine:f"}, "cost.function: 'mine:f' is Python code"),
        ({"cost": {"name": "total", "function": "mine:f"}}, "cost.function: 'mine:f' is Python"),
        (constraint(function="mine:f"), "constraints[0].function: 'mine:f' is Python code"),
    ],
)
def test_code_runs_only_where_it_is_allowed(tmp_path, refuse, changes, phrase):
    (tmp_path / "mine.py").write_text(f"open('was_here', 'w').close()\n{SOURCE}")
    refuse(changes, phrase, "add --allow-code")


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        ({"cost.function": "mine"}, ["cost.function: must be \"module:name\" but is 'mine'"]),
        ({"cost.function": "mine:g"}, ["mine:g: must be a function that can be imported"]),
        ({"cost.function": "no_such:f"}, ["no_such:f: must be a function", "beside the config"]),
        (constraint(function="mine:g"), ["mine:g: must be a function that can be imported"]),
        (constraint(function="mine:f", upper=1), ["constraints[0].upper: must be left out beside"]),
    ],
)
def test_code_that_cannot_run(tmp_path, refuse, changes, phrases):
    (tmp_path / "mine.py").write_text(SOURCE)
    refuse(changes, *phrases, allow=True)


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        ({"multistart.n": 0}, ["multistart.n: must be greater than 0 but is 0"]),
        ({"multistart.n": -3}, ["multistart.n: must be ", "but is -3"]),
        ({"multistart.n": 2.5}, ["multistart.n: must be a whole number but is 2.5"]),
        ({"multistart.sampler": "halton"}, ["must be 'sobol', 'latin_hypercube' or 'uniform'"]),
        ({"multistart.points": {"m": 1.0}}, ["multistart.points: must be a list but is"]),
        ({"multistart.points": [3]}, ["multistart.points[0]: must be a table but is 3"]),
        ({"multistart.points": [{"m": float("inf")}]}, ["points[0].m: must be a finite number"]),
        ({"multistart.screen": 0}, ["multistart.screen: must be greater than 0 but is 0"]),
        ({"multistart.at_once": 0}, ["multistart.at_once: must be greater than 0 but is 0"]),
        ({"multistart.patience": -1}, ["multistart.patience: must be at least 0 but is -1"]),
        ({"multistart.same": 0}, ["multistart.same: must be greater than 0 but is 0"]),
        ({"uncertainty.profiles": ["q"]}, ["uncertainty.profiles: must name", "has 'm', 'k'"]),
        ({"uncertainty.profiles": "m"}, ["uncertainty.profiles: must be a list but is 'm'"]),
        (
            {"uncertainty.bootstrap": 5},
            ["uncertainty.bootstrap: needs at least 5 training experiments", "there are 1"],
        ),
        ({"uncertainty.confidence": 95}, ["uncertainty.confidence: must be less than 1 but is 95"]),
        ({"uncertainty.confidence": 0.1}, ["uncertainty.confidence: must be at least 0.5"]),
        ({"uncertainty.steps": 0}, ["uncertainty.steps: must be ", "but is 0"]),
        ({"uncertainty.max_steps": 1}, ["uncertainty.max_steps: must be ", "but is 1"]),
        ({"closed_loop.draws": 1}, ["closed_loop.draws: must be ", "but is 1"]),
    ],
)
def test_starts_and_uncertainty(refuse, changes, phrases):
    refuse(changes, *phrases)


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        ({"multistart.points": [{"q": 1.0}]}, ["there is no unknown 'q'; it has 'm', 'k'"]),
        ({"multistart.points": [{"m": 99.0}]}, ["m must lie in its bounds [0.1, 10] but is 99"]),
        (
            {"multistart.n": 3, "parameters.m.bounds": REMOVED},
            ["parameters.m.bounds: must be finite", "are [-inf, inf]", "multistart.points instead"],
        ),
        (
            {"multistart.n": 3, "parameters.k.bounds": [0.0, 99.0]},
            ["parameters.k.bounds: must be finite", "positive", "but are [0, 99]"],
        ),
    ],
)
def test_starts_that_do_not_suit_the_parameters(refuse, changes, phrases):
    """Nothing may be simulated, and no folder written, before this is seen."""
    refuse(changes, *phrases)


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        (
            {"method": {"name": "scipy_least_squares"}, **constraint(expression="m <= k")},
            ["method.name: scipy_least_squares cannot satisfy constraints", "'m <= k'", "choose"],
        ),
        (
            {"method": {"name": "scipy_least_squares"}, **on_y(upper=1.0)},
            ["scipy_least_squares cannot satisfy constraints", "'y upper [a]'", "or remove them"],
        ),
        (
            {"method": {"name": "scipy_least_squares"}, "cost.name": "sae"},
            ["method.name: scipy_least_squares needs residuals", "cost.name is 'sae'"],
        ),
        (
            {"method": {"name": "scipy_least_squares"}, "cost.name": "huber"},
            ["scipy_least_squares", "cost.name is 'huber'"],
        ),
        (
            {"method": {"name": "nelder_mead"}},
            ["parameters.m.bounds: must be absent", "[0.1, 10]", 'bounds = "enforce"'],
        ),
        (
            {"method": {"name": "nelder_mead"}, **constraint(expression="m <= k")},
            ["method.name: nelder_mead cannot satisfy constraints"],
        ),
        (
            {"method": {"name": "pattern_search", "options": {"contraction": 1.5}}},
            ["method.options.contraction: must be", "1.5"],
        ),
        (
            {"method": {"name": "de"}, "parameters.m.bounds": REMOVED},
            ["parameters.m.bounds: must be finite"],
        ),
        (
            {"method": {"name": "sqp", "options": {"algorithm": "ipopt"}}},
            ["method.options.algorithm: must be one of 'native'", "but is 'ipopt'"],
        ),
    ],
)
def test_a_method_that_does_not_suit_the_problem(refuse, changes, phrases):
    refuse(changes, *phrases)
