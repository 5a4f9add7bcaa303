"""Values of signals in the training experiments, for the shapes of declared effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.fit_tables import EffectCurve
from cluster_est.results.result import Result
from cluster_est.results.shapes.effect_shapes import UNKNOWN_ARGUMENT, effect_shapes
from cluster_est.running.runner import Runner
from workers.effects.site import EffectSite, split_variable
from workers.grid import values_at
from workers.messages import Experiment, FloatArray, Outcome

Signals = Mapping[str, FloatArray]

MOST_LINEARISATION_ENTRIES = 20_000_000
"""Largest number of entries in the matrices of all linearisations: 160 MB."""

PLAIN = "before effects: "
"""Prefix of the name of an input or output without effects."""


def declared_shapes(runner: Runner, train: SearchSpace, result: Result) -> tuple[EffectCurve, ...]:
    """Compute the shapes of the effects that a problem declares.

    Outputs, inputs and measured signals are known from the simulations at the estimates. If a shape
    needs a state, each training experiment is linearised once. This requires model exchange and
    sufficient memory.
    """
    problem = result.problem
    outcomes = {s.experiment: s.outcome for s in result.simulations}
    chosen = [outcomes[e] for e in train.experiments]
    shapes = _shapes(train, chosen, result)
    unknown = any(shape.why_not.startswith(UNKNOWN_ARGUMENT) for shape in shapes)
    if not unknown or problem.model.interface != "model_exchange" or not _fits(chosen, result):
        return shapes
    values = train.physical(result.solution.x)
    found = runner.simulate(values, train.experiments, "linearisation", "shapes", problem.effects)
    chosen = [new if new.ok else old for new, old in zip(found, chosen, strict=True)]
    return _shapes(train, chosen, result)


def _fits(outcomes: Sequence[Outcome], result: Result) -> bool:
    """Return whether linearisations of all experiments are small enough."""
    times = sum(len(o.trajectory.times) for o in outcomes if o.trajectory is not None)
    return times * len(result.problem.describe().states) ** 2 <= MOST_LINEARISATION_ENTRIES


def _shapes(
    train: SearchSpace, outcomes: Sequence[Outcome], result: Result
) -> tuple[EffectCurve, ...]:
    """Return the shapes whose arguments are known from these outcomes."""
    problem = result.problem
    pairs = zip(train.experiments, outcomes, strict=True)
    known = [_signals(problem.experiments[e], outcome) for e, outcome in pairs]

    def visited(site: EffectSite, name: str) -> FloatArray:
        own = site.kind == "output" or (site.kind == "input" and name == site.target)
        if own and any(PLAIN + name in each for each in known):
            name = PLAIN + name
        first, *second = split_variable(name, {n for each in known for n in each}) or (name,)
        seen = [s for s in known if all(one in s for one in (first, *second))]
        parts = [s[first] - (s[second[0]] if second else 0.0) for s in seen]
        return np.concatenate(parts or [np.zeros(0)])

    return effect_shapes(result, problem.describe(), visited)


def _signals(experiment: Experiment, outcome: Outcome) -> Signals:
    """Return the signals of an experiment by name, at the times of its simulation."""
    linear, trajectory = outcome.linearisation, outcome.trajectory
    if linear is not None:
        plain = [PLAIN + name for name in linear.output_names]
        found = {
            **dict(zip(plain, linear.plain_outputs.T, strict=True)),
            **dict(zip(linear.output_names, linear.outputs.T, strict=True)),
            **dict(zip(linear.state_names, linear.states.T, strict=True)),
            **dict(zip(linear.input_names, linear.effective_inputs.T, strict=True)),
        }
        times = linear.times
    elif trajectory is not None:
        found = dict(zip(trajectory.variables, trajectory.values.T, strict=True))
        times = trajectory.times
    else:
        return {}
    driven = {given.variable: values_at(given, times) for given in experiment.inputs}
    measured = {given.variable: values_at(given, times) for given in experiment.signals}
    before = {PLAIN + name: values for name, values in driven.items()}
    return driven | measured | found | before | {"time": times}
