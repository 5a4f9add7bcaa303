"""The true structure in the library's forms, refitted: the result of a perfect method.

It is used only for scoring, where the truth may be known; the true numbers serve as starts. An
effect whose form the library lacks, or that needs a variable that the FMU does not expose, has no
oracle. Its likelihood ratio is then that of the truth itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from closed_loop_benchmark.data import Data, run_of, start_label
from closed_loop_benchmark.effect import Effect
from cluster_est import ClusterEstError, LeastSquares, Parameter, Problem, Resources
from cluster_est.methods.method import Solution
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.problem.variables import coefficient_names
from cluster_est.running.environment import open_executor
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.effects.definition import coefficients
from workers.errors import EffectError
from workers.messages import Effect as AddedEffect

Numbers = tuple[float, ...]
Translation = Callable[[Numbers], dict[str, float]]

LIBRARY_NAMES = {
    ("der", "end_stop"): "gap",
    ("der", "leak"): "signed_root",
    ("der", "cogging"): "periodic_travel",
    ("der", "pressed_friction"): "load_dependent_coulomb",
    ("parameter", "periodic_time"): "sine",
    ("parameter", "saturating_square"): "hill",
    ("output", "saturation"): "clip_above",
}
"""Forms that have another name in the library than in the benchmark."""

SCALES = {"limit", "tau", "width", "vs", "x0", "f", "n", "rate", "half"}
"""Coefficients that are positive and of unknown magnitude."""

PLAYS = {"dead_zone", "backlash"}
"""Forms whose strength is a width, and therefore also positive."""


def _same(a: Numbers) -> dict[str, float]:
    return {"k": a[0]}


def _taken(a: Numbers) -> dict[str, float]:
    """Return a strength that the library subtracts."""
    return {"k": -a[0]}


def _wave(a: Numbers) -> dict[str, float]:
    """Return the two coefficients of a sine with a phase, and its angular frequency."""
    return {**_two_parts(a[0], a[2]), "f": 2.0 * math.pi * a[1]}


def _ripple(a: Numbers) -> dict[str, float]:
    """Return the two coefficients of a wave in a state, and its wave number."""
    amplitude, number, phase = (*a, 0.0)[:3]
    return {**_two_parts(amplitude, phase), "n": number}


def _two_parts(amplitude: float, phase: float) -> dict[str, float]:
    return {"a": amplitude * math.cos(phase), "b": amplitude * math.sin(phase)}


RATE: dict[str, Translation] = {
    **dict.fromkeys(("constant", "drift", "linear", "square", "product"), _same),
    **dict.fromkeys(("viscous", "quadratic", "cubic", "square_root", "leak"), _taken),
    "sine": _wave,
    **dict.fromkeys(("periodic", "cogging"), _ripple),
    **dict.fromkeys(("coulomb", "pressed_friction"), lambda a: {"k": -a[0], "width": a[1]}),
    "stribeck": lambda a: {"k": -a[0], "peak": -a[0] * a[3], "vs": a[2], "width": a[1]},
    "dahl": lambda a: {"k": -a[0], "x0": a[1]},
    "end_stop": lambda a: {"k": -a[0], "at": a[1]},
    "hinge": lambda a: {"k": a[0], "at": a[1]},
    "lagged": lambda a: {"k": a[0], "tau": a[1]},
    "saturating": lambda a: {"k": a[0], "half": a[1]},
}

PAIR: dict[str, Translation] = {
    **dict.fromkeys(("linear", "quadratic", "cubic", "leak"), _taken),
    **dict.fromkeys(("gap", "joint"), lambda a: {"k": -a[0], "at": a[1]}),
    "coulomb": lambda a: {"k": -a[0], "width": a[1]},
}

INPUT: dict[str, Translation] = {
    **dict.fromkeys(
        ("bias", "gain", "drift", "square", "cubic", "asymmetry", "product", *PLAYS), _same
    ),
    "saturation": lambda a: {"limit": a[0]},
    "periodic": _ripple,
    "rate_limit": lambda a: {"rate": a[0]},
    **dict.fromkeys(("lag", "delay"), lambda a: {"tau": a[0]}),
}

OUTPUT: dict[str, Translation] = {
    **dict.fromkeys(
        ("bias", "gain", "drift", "square", "cubic", "absolute", "feed_through"), _same
    ),
    "saturation": lambda a: {"limit": a[0]},
    **dict.fromkeys(("lag", "delay"), lambda a: {"tau": a[0]}),
    "lagged_feed_through": lambda a: {"k": a[0], "tau": a[1]},
    "hysteresis": lambda a: {"k": a[0], "x0": a[1]},
    "hum": _wave,
}

PARAMETER: dict[str, Translation] = {
    **dict.fromkeys(("drift", "linear", "magnitude", "square"), lambda a: {"k": a[0], "at": a[1]}),
    "saturating": lambda a: {"k": -a[0], "half": a[1]},
    "saturating_square": lambda a: {"k": -a[0], "half": a[1]},
    "periodic_time": _wave,
    "heating": lambda a: {"k": a[0], "at": a[2], "tau": a[1]},
}

TRANSLATIONS = {"der": RATE, "pair": PAIR, "input": INPUT, "output": OUTPUT, "parameter": PARAMETER}


@dataclass(frozen=True)
class Oracle:
    """Results of the true structure.

    Attributes
    ----------
    fit
        Fit of the true structure; None if the library cannot express it.
    truth
        The truth itself, not refitted: its residuals are the noise.
    coefficients
        Number of the true effects' free coefficients in the library; without a fit, the numbers of
        the truth.
    reason
        Why there is no fit.
    """

    fit: Refit | None
    truth: Refit
    coefficients: int = 0
    reason: str = ""

    @property
    def best(self) -> Refit:
        """The fit; without a fit, the truth itself."""
        return self.fit or self.truth


def ask(data: Data, problem: Problem) -> Oracle:
    """Refit the true structure of a case.

    Parameters
    ----------
    data
        The case, with its truth.
    problem
        The problem given to a method, without the samples that it has excluded; effects are added.

    Returns
    -------
    Oracle
        Without a fit for effects outside the library and for disturbances.
    """
    truth, effects = _noise(data, problem), data.scenario.effects
    if data.scenario.disturbance is not None and not effects:
        return Oracle(None, truth, reason="a disturbance has no structure")
    try:
        added = [translate(effect, n) for n, effect in enumerate(effects)]
        whole = with_effects(problem, added)
        whole.describe()
        free = sum(count_free(effect) for effect, _ in added)
        return Oracle(refit(whole, true_values(data)), truth, free)
    except (KeyError, ClusterEstError, EffectError) as error:
        numbers = sum(len(effect.numbers) for effect in effects)
        return Oracle(None, truth, numbers, f"{type(error).__name__}: {error}")


def translate(effect: Effect, number: int) -> tuple[AddedEffect, dict[str, float]]:
    """Convert an effect to the library's form.

    Returns
    -------
    AddedEffect, dict of float
        The effect, and the true value of each of its coefficients.

    Raises
    ------
    KeyError
        If the library has no such form.
    """
    values = dict(effect.constants)
    if not values:
        values = TRANSLATIONS[effect.kind][effect.form](effect.numbers)
    if effect.kind == "pair" and not effect.constants:
        first, second = effect.weights
        values |= {"k": values["k"] * first, "back": -values["k"] * second}
    form = LIBRARY_NAMES.get((effect.kind, effect.form), effect.form)
    variables = tuple(name for name in (effect.variable, effect.second) if name)
    variables = tuple(name.replace("-", " - ") for name in variables)
    return AddedEffect(f"true_{number}", effect.site, form, variables), values


def with_effects(problem: Problem, added: list[tuple[AddedEffect, dict[str, float]]]) -> Problem:
    """Add effects and their coefficients to a problem.

    Raises
    ------
    KeyError
        If an effect has other coefficients than its form in the library.
    """
    parameters = list(problem.parameters)
    for effect, values in added:
        names = coefficient_names(effect)
        if set(names) != set(values):
            raise KeyError(f"{effect.form} has the coefficients {names}, not {list(values)}")
        parameters += [_coefficient(effect, name, values[name]) for name in names]
    effects = tuple(effect for effect, _ in added)
    return replace(problem, parameters=tuple(parameters), effects=effects)


def count_free(effect: AddedEffect) -> int:
    """Return the number of coefficients that are fitted and not held in a search for an effect."""
    return sum(not c.held for c in coefficients(effect, effect.name))


def true_values(data: Data) -> dict[str, float]:
    """Return the true parameters and unknown initial states by label."""
    starts = {
        start_label(state, number, run): run.true_starts[state]
        for number, run in enumerate(data.experiments)
        for state in data.system.unknown_starts
    }
    return {**data.true_parameters, **starts}


def _coefficient(effect: AddedEffect, name: str, value: float) -> Parameter:
    label = f"{effect.name}.{name}"
    if name in SCALES or effect.form in PLAYS:
        return Parameter(label, value, (value / 10.0, value * 10.0), "log")
    # The reference point of a varying parameter is a convention, compensated by the parameter.
    convention = name == "at" and effect.site.startswith("parameter")
    reach = 20.0 * abs(value) or 1.0
    return Parameter(label, value, (value - reach, value + reach), fixed=convention)


def _noise(data: Data, problem: Problem) -> Refit:
    """Return the distance of the used data from the truth."""
    squares: Mapping[str, list[float]] = {"train": [], "test": []}
    sizes = {"train": 0, "test": 0}
    for given in problem.experiments:
        run = run_of(data, given.id)
        kept = np.stack([np.isin(data.times, output.times) for output in given.outputs], axis=1)
        residuals = ((run.outputs - run.true_outputs) / data.sigma)[kept]
        squares[given.role].append(float(np.sum(residuals**2)))
        sizes[given.role] += residuals.size
    sums = {role: sum(found) for role, found in squares.items()}
    train, test = (float(np.sqrt(sums[role] / sizes[role])) for role in ("train", "test"))
    return Refit(sums["train"], train, test, {})


METHOD = LeastSquares(differences="forward", max_iterations=40, ftol=1e-8, xtol=1e-8)


@dataclass(frozen=True)
class Refit:
    """A structure fitted to the training runs.

    Attributes
    ----------
    sse
        Sum of squares over all training runs, in standard deviations of the noise.
    train, test
        Root mean squares on training and on held-out runs.
    values
        Estimates by label.
    """

    sse: float
    train: float
    test: float
    values: dict[str, float]


def refit(problem: Problem, starts: Mapping[str, float], held_out: bool = True) -> Refit:
    """Fit a problem to its training runs.

    Parameters
    ----------
    problem
        The problem with the effects of the structure.
    starts
        Starts by label; without a label, the parameter's own start is used.
    held_out
        Whether to simulate the held-out runs too. Their own unknowns, such as an unknown initial
        state, are fitted to them.

    Returns
    -------
    Refit
        NaN if a simulation failed.
    """
    training, others = problem.indices("train"), problem.indices("test")
    with open_executor(problem, Resources()) as executor:
        runner = Runner(executor)
        space = _from(make_space(problem, training), starts)
        solution = _search(runner, space)
        values, test = space.estimates(solution.x), np.nan
        if held_out and others:
            there = _from(make_space(problem, others, values), starts)
            test = _rms(problem, others, _follow(runner, there))
    sse = solution.cost
    return Refit(sse, _rms(problem, training, sse), test, values)


def _from(space: SearchSpace, starts: Mapping[str, float]) -> SearchSpace:
    """Set the given starts of unknowns, moved into their bounds."""
    unknowns = []
    for unknown in space.unknowns:
        low, high = unknown.parameter.lower, unknown.parameter.upper
        start = float(np.clip(starts.get(unknown.label, unknown.start), low, high))
        unknowns.append(replace(unknown, start=start))
    return replace(space, unknowns=tuple(unknowns))


def _search(runner: Runner, space: SearchSpace) -> Solution:
    (solution,) = runner.run([SearchRequest("refit", METHOD, space)])
    return solution


def _follow(runner: Runner, space: SearchSpace) -> float:
    """Return the sum of squares on runs whose shared values are known."""
    if space.size:
        return _search(runner, space).cost
    values, effects = space.physical(space.start), space.problem.effects
    outcomes = runner.simulate(values, space.experiments, "residuals", "refit", effects)
    residuals = [o.residuals for o in outcomes if o.residuals is not None]
    if len(residuals) < len(outcomes):
        return np.nan
    return space.problem.cost.value(np.concatenate(residuals), space.outputs)


def _rms(problem: Problem, runs: tuple[int, ...], sse: float) -> float:
    return float(np.sqrt(sse / sum(problem.experiments[run].size for run in runs)))
