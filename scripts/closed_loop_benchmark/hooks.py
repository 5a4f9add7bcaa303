"""Where the effects that act within a step are hooked into the equations of a system."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from closed_loop_benchmark.effect import Effect
from closed_loop_benchmark.rate_forms import MEMORIES, PARAMETER_LAWS, RATE_LAWS, Law, Value
from closed_loop_benchmark.system import Array, System

SMALLEST_FACTOR = 0.02
"""No effect may turn a parameter negative."""


@dataclass
class Moment:
    """All values at one time, the states' memories behind the states; a column for each run."""

    time: float
    states: Array
    inputs: list[Value]
    signals: Array
    parameters: list[Value]


Reader = Callable[[Moment], Value]


@dataclass(frozen=True)
class Hook:
    """An effect made ready for a system.

    Attributes
    ----------
    effect, law
        What acts, and how.
    targets
        Places of the input, the parameter or the states that it acts on.
    first, second
        Read the variables of the law.
    memory
        Row of the memory behind the states.
    """

    effect: Effect
    law: Law
    targets: tuple[int, ...]
    first: Reader
    second: Reader
    memory: int

    def value(self, moment: Moment) -> Value:
        """Evaluate the law."""
        z = moment.states[self.memory]
        v, w = self.first(moment), self.second(moment)
        return self.law(self.effect.numbers, moment.time, v, w, z)

    def memory_rate(self, moment: Moment) -> Value:
        """Evaluate the rate of the memory, which is zero for most."""
        rate = MEMORIES.get(self.effect.form)
        if rate is None:
            return 0.0
        return rate(self.effect.numbers, self.first(moment), moment.states[self.memory])


def make_hooks(system: System, effects: Sequence[Effect]) -> list[Hook]:
    """Return the hooks of those effects that act within a step."""
    inside = [e for e in effects if acts_inside(e)]
    return [_make_hook(system, e, len(system.states) + n) for n, e in enumerate(inside)]


def acts_inside(effect: Effect) -> bool:
    """Tell whether an effect depends on the states or changes their equations."""
    return effect.kind in ("der", "pair", "parameter") or (
        effect.kind == "input" and bool(effect.variable)
    )


def change_inputs_and_parameters(hooks: Sequence[Hook], moment: Moment) -> None:
    """Let the effects at inputs and parameters act, in their order."""
    for hook in hooks:
        if hook.effect.kind == "input":
            (place,) = hook.targets
            moment.inputs[place] = moment.inputs[place] + hook.value(moment)
        elif hook.effect.kind == "parameter":
            (place,) = hook.targets
            factor = np.maximum(1.0 + hook.value(moment), SMALLEST_FACTOR)
            moment.parameters[place] = moment.parameters[place] * factor


def rates(system: System, hooks: Sequence[Hook], moment: Moment) -> Array:
    """Return the rates of all states and memories."""
    change_inputs_and_parameters(hooks, moment)
    own = moment.states[: len(system.states)]
    found = np.zeros_like(moment.states)
    for place, rate in enumerate(system.rates(own, moment.inputs, moment.parameters)):
        found[place] = rate
    for hook in hooks:
        found[hook.memory] = hook.memory_rate(moment)
        if hook.effect.kind in ("der", "pair"):
            value = hook.value(moment)
            for place, weight in zip(hook.targets, hook.effect.weights, strict=True):
                found[place] += weight * value
    return found


def _make_hook(system: System, effect: Effect, memory: int) -> Hook:
    law = (PARAMETER_LAWS if effect.kind == "parameter" else RATE_LAWS)[effect.form]
    listed = {
        "input": system.inputs,
        "parameter": (*system.parameters, *system.constants),
    }.get(effect.kind, system.states)
    targets = tuple(listed.index(target) for target in effect.targets)
    # A product at an input is one of the input itself and a variable.
    second = effect.targets[0] if effect.kind == "input" else effect.second
    return Hook(
        effect, law, targets, reader(system, effect.variable), reader(system, second), memory
    )


def reader(system: System, name: str) -> Reader:
    """Return a function that reads a state, input, signal or a difference "a-b" of two."""
    if not name:
        return lambda moment: 0.0
    if "-" in name:
        left, right = (reader(system, part) for part in name.split("-"))
        return lambda moment: left(moment) - right(moment)
    if name in system.states:
        row = system.states.index(name)
        return lambda moment: moment.states[row]
    if name in system.inputs:
        row = system.inputs.index(name)
        return lambda moment: moment.inputs[row]
    row = system.signals.index(name)
    return lambda moment: moment.signals[row]
