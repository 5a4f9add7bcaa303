"""Simulation of the true system without its FMU: its own equations and the missing effects.

All runs of a system are integrated at once by the classic Runge-Kutta method with steps much
shorter than the sampling interval. Inputs are linear between samples. Undeclared effects at inputs
are applied to the signals before the simulation, and those at outputs afterwards. All others act on
the rates and parameters within each step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from closed_loop_benchmark.effect import Effect
from closed_loop_benchmark.forms import (
    INPUT_FORMS,
    MEMORIES,
    OUTPUT_FORMS,
    PARAMETER_LAWS,
    RATE_LAWS,
    Law,
    Value,
)
from closed_loop_benchmark.system import Array, Run, System


@dataclass(frozen=True)
class Push:
    """An unmeasured disturbance of a rate.

    Attributes
    ----------
    state
        The state whose rate is disturbed.
    signal : (samples, runs)
        Linear between the samples.
    """

    state: str
    signal: Array


@dataclass(frozen=True)
class Course:
    """All excitations of a system, at every half integration step; runs are the last axis."""

    times: Array
    inputs: Array
    signals: Array
    pushes: Array


def simulate(
    system: System,
    runs: Sequence[Run],
    effects: Sequence[Effect] = (),
    pushes: Sequence[Push] = (),
    parameters: Mapping[str, float] | None = None,
) -> list[Array]:
    """Return the outputs without noise at the sampling times.

    Parameters
    ----------
    system
        The system.
    runs
        Inputs and true initial states.
    effects
        Effects that the FMU lacks, in the order in which they act on a signal.
    pushes
        Disturbances.
    parameters
        Other values than the true ones.

    Returns
    -------
    list of (samples, outputs)
        One array for each run.
    """
    values = {**system.parameters, **system.constants, **(parameters or {})}
    course = lay_out(system, runs, effects, pushes)
    states, inputs, outputs = integrate(system, runs, effects, course, list(values.values()))
    known = {
        **dict(zip(system.states, states.swapaxes(0, 1), strict=False)),
        **dict(zip(system.inputs, inputs.swapaxes(0, 1), strict=True)),
        **dict(zip(system.signals, course.signals[::2].swapaxes(0, 1), strict=True)),
    }
    for effect in (e for e in effects if e.kind == "output"):
        place, v = system.outputs.index(effect.targets[0]), known.get(effect.variable, np.zeros(0))
        change = OUTPUT_FORMS[effect.form]
        outputs[:, place] = change(effect.numbers, course.times[::2], outputs[:, place], v)
    sampled = outputs[:: system.substeps]
    return [sampled[:, :, r] for r in range(len(runs))]


def lay_out(
    system: System, runs: Sequence[Run], effects: Sequence[Effect], pushes: Sequence[Push]
) -> Course:
    """Refine the samples of all runs, and apply the effects at inputs."""
    halves = 2 * system.substeps  # the integration also needs the middle of each step
    times = refine(system.times, halves)
    inputs = refine(np.stack([run.inputs for run in runs], axis=-1), halves)
    for effect in (e for e in effects if e.kind == "input" and not acts_inside(e)):
        place, none = system.inputs.index(effect.targets[0]), np.zeros(0)
        inputs[:, place] = INPUT_FORMS[effect.form](effect.numbers, times, inputs[:, place], none)
    signals = refine(np.stack([run.signals for run in runs], axis=-1), halves)
    pushed = np.zeros((len(times), len(system.states), len(runs)))
    for push in pushes:
        pushed[:, system.states.index(push.state)] += refine(push.signal, halves)
    return Course(times, inputs, signals, pushed)


def refine(samples: Array, pieces: int) -> Array:
    """Divide each interval between two samples into pieces, with linear interpolation."""
    share = (np.arange(pieces) / pieces).reshape(-1, *[1] * (samples.ndim - 1))
    between = samples[:-1, None] + share * np.diff(samples, axis=0)[:, None]
    flat = between.reshape((len(samples) - 1) * pieces, *samples.shape[1:])
    return np.concatenate([flat, samples[-1:]])


def integrate(
    system: System,
    runs: Sequence[Run],
    effects: Sequence[Effect],
    course: Course,
    values: Sequence[float],
) -> tuple[Array, Array, Array]:
    """Integrate all runs together.

    Returns
    -------
    states, inputs, outputs
        At every step: time first, runs last. Memories of effects follow the states; inputs include
        effects.
    """
    active = make_hooks(system, effects)
    n_states, step = len(system.states), 2.0 * (course.times[1] - course.times[0])

    def moment(place: int, x: Array) -> Moment:
        inputs, signals = list(course.inputs[place]), course.signals[place]
        return Moment(course.times[place], x, inputs, signals, list(values))

    def flow(place: int, x: Array) -> Array:
        found = rates(system, active, moment(place, x))
        found[:n_states] += course.pushes[place]
        return found

    starts = [[run.starts[state] for run in runs] for state in system.states]
    x = np.array(starts + [[0.0] * len(runs)] * len(active))
    count = (len(course.times) + 1) // 2
    states, inputs = np.empty((count, *x.shape)), course.inputs[::2].copy()
    outputs = np.empty((count, len(system.outputs), len(runs)))
    for n in range(count):
        now = moment(2 * n, x)
        change_inputs_and_parameters(active, now)
        states[n] = x
        inputs[n] = now.inputs
        outputs[n] = system.readings(x[:n_states], now.inputs, now.parameters)
        if n + 1 < count:
            x = _step(flow, 2 * n, x, step)
    return states, inputs, outputs


def _step(flow: Callable[[int, Array], Array], place: int, x: Array, h: float) -> Array:
    """Return one classic Runge-Kutta step, which is two positions of the course."""
    k1 = flow(place, x)
    k2 = flow(place + 1, x + 0.5 * h * k1)
    k3 = flow(place + 1, x + 0.5 * h * k2)
    k4 = flow(place + 2, x + h * k3)
    return x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)


SMALLEST_FACTOR = 0.02
"""Smallest factor of a parameter, so that no effect makes it negative."""


@dataclass
class Moment:
    """All values at one time, with memories after the states; a column for each run."""

    time: float
    states: Array
    inputs: list[Value]
    signals: Array
    parameters: list[Value]


Reader = Callable[[Moment], Value]


@dataclass(frozen=True)
class Hook:
    """An effect prepared for a system.

    Attributes
    ----------
    effect, law
        The effect and its law.
    targets
        Positions of the input, the parameter or the states on which it acts.
    first, second
        Read the variables of the law.
    memory
        Row of the memory after the states.
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
        """Evaluate the rate of the memory, which is zero for most laws."""
        rate = MEMORIES.get(self.effect.form)
        if rate is None:
            return 0.0
        return rate(self.effect.numbers, self.first(moment), moment.states[self.memory])


def make_hooks(system: System, effects: Sequence[Effect]) -> list[Hook]:
    """Return the hooks of the effects that act within a step."""
    inside = [e for e in effects if acts_inside(e)]
    return [_make_hook(system, e, len(system.states) + n) for n, e in enumerate(inside)]


def acts_inside(effect: Effect) -> bool:
    """Return whether an effect depends on the states or changes their equations."""
    return effect.kind in ("der", "pair", "parameter") or (
        effect.kind == "input" and bool(effect.variable)
    )


def change_inputs_and_parameters(hooks: Sequence[Hook], moment: Moment) -> None:
    """Apply the effects at inputs and parameters, in their order."""
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
    # A product at an input is that of the input itself and a variable.
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
