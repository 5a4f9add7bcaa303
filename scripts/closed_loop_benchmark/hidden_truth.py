"""True behaviour of a system with hidden dynamics, by SciPy from equations as text.

This module does not use the library's forms. The complete true system, with the states that the
declared model lacks, is integrated from one sample to the next, for all runs at once. Delayed
values are read from the dense output of earlier steps; before the start, they are constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from types import CodeType
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from closed_loop_benchmark.hidden_systems import FILE
from closed_loop_benchmark.system import Array, Run, System

FUNCTIONS = {
    "sin": np.sin, "cos": np.cos, "exp": np.exp, "tanh": np.tanh, "sqrt": np.sqrt, "abs": np.abs,
    "sign": np.sign, "where": np.where,
}  # fmt: skip
RTOL, ATOL = 1e-8, 1e-9

Texts = Mapping[str, str]


@dataclass(frozen=True)
class Hidden:
    """Additional parts of a true system, as equations.

    Attributes
    ----------
    numbers
        Values of names in the equations.
    states
        Additional states: a rate, and a start that is an equation or an interval from which it is
        drawn for each run.
    late
        Names of delayed values: an equation of the declared model, and the delay.
    rates
        Terms that are added to rates of the declared states.
    inputs, parameters, outputs
        Replacements of these.
    """

    numbers: Mapping[str, float] = field(default_factory=dict)
    states: Mapping[str, tuple[str, str | list[float]]] = field(default_factory=dict)
    late: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    rates: Texts = field(default_factory=dict)
    inputs: Texts = field(default_factory=dict)
    parameters: Texts = field(default_factory=dict)
    outputs: Texts = field(default_factory=dict)


NOTHING = Hidden()


def follow(
    system: System,
    runs: Sequence[Run],
    hidden: Hidden = NOTHING,
    *,
    share: float = 1.0,
    push: tuple[str, Array] | None = None,
    seed: int = 0,
) -> list[Array]:
    """Return the outputs without noise at the sampling times.

    Parameters
    ----------
    system, runs
        The declared system, inputs and true initial states.
    hidden
        Its additional parts.
    share
        Share of these that acts; with 0, the declared model remains.
    push
        A state, and a disturbance of its rate, (samples, runs), linear between samples.
    seed
        Seed of random starts.

    Returns
    -------
    list of (samples, outputs)
        One array for each run.
    """
    course = _Course(system, runs, hidden, share, push)
    x = course.begin(np.random.default_rng(seed))
    outputs = np.empty((system.samples, len(system.outputs), len(runs)))
    for n, time in enumerate(system.times):
        outputs[n] = course.outputs(time, x)
        if n + 1 < system.samples:
            x = course.advance(n, x)
    return [outputs[:, :, run] for run in range(len(runs))]


class _Course:
    """The integration of all runs of a system."""

    def __init__(
        self,
        system: System,
        runs: Sequence[Run],
        hidden: Hidden,
        share: float,
        push: tuple[str, Array] | None,
    ) -> None:
        self.system, self.hidden, self.share = system, hidden, share
        self.inputs = np.stack([run.inputs for run in runs], axis=-1)
        starts = [[run.starts[state] for run in runs] for state in system.states]
        self.start, self.states = np.array(starts), [*system.states, *hidden.states]
        self.pushed, self.push = push or ("", np.zeros((system.samples, len(runs))))
        given = FILE[system.name]
        self.rates: Texts = given["rates"]
        self.readings = {output: text for output, (_, text) in given["outputs"].items()}
        self.values = {**system.parameters, **system.constants, **hidden.numbers}
        self.steps: list[Any] = []

    def begin(self, random: np.random.Generator) -> Array:
        """Return all states at the start, (states, runs)."""
        known = self.declared(0.0, self.start)
        count, rows = self.start.shape[1], [*self.start]
        for _, start in self.hidden.states.values():
            if isinstance(start, str):
                rows.append(np.broadcast_to(_evaluate(start, known), count))
            else:
                low, high = start
                rows.append(random.uniform(low, high, count))
        self.first = np.array(rows, dtype=float)
        return self.first

    def advance(self, n: int, x: Array) -> Array:
        """Integrate from sample n to the next."""
        first, last = self.system.interval * n, self.system.interval * (n + 1)
        found = solve_ivp(
            lambda t, y: self.slope(t, y.reshape(x.shape), n).ravel(),
            (first, last),
            x.ravel(),
            "DOP853",
            dense_output=bool(self.hidden.late),
            rtol=RTOL,
            atol=ATOL,
            first_step=0.5 * self.system.interval,
        )
        if not found.success:
            raise RuntimeError(f"{self.system.name}: {found.message}")
        self.steps.append(found.sol)
        return np.asarray(found.y[:, -1].reshape(x.shape))

    def slope(self, time: float, x: Array, n: int) -> Array:
        """Return the rates of all states within the step from sample n."""
        known = self.complete(time, x, n)
        own = [_evaluate(self.rates[state], known) for state in self.system.states]
        rates = dict(zip(self.system.states, own, strict=True))
        for state, text in self.hidden.rates.items():
            rates[state] = rates[state] + self.share * _evaluate(text, known)
        if self.pushed:
            rates[self.pushed] = rates[self.pushed] + self.between(self.push, time, n)
        hidden = [_evaluate(rate, known) for rate, _ in self.hidden.states.values()]
        rows = [*rates.values(), *hidden]
        return np.array([np.broadcast_to(row, x.shape[1]) for row in rows])

    def outputs(self, time: float, x: Array) -> Array:
        """Return the values of the sensors, (outputs, runs)."""
        known = self.complete(time, x)
        shown = {
            output: self.mixed(known[output], self.hidden.outputs.get(output), known)
            for output in self.system.outputs
        }
        return np.array([np.broadcast_to(row, x.shape[1]) for row in shown.values()])

    def complete(self, time: float, x: Array, n: int | None = None) -> dict[str, Any]:
        """Return the values of all names."""
        known = self.declared(time, x, n)
        for name, (text, duration) in self.hidden.late.items():
            before = time - float(_evaluate(duration, known))
            known[name] = _evaluate(text, self.declared(max(before, 0.0), self.past(before)))
        for changes in (self.hidden.inputs, self.hidden.parameters):
            for name, text in changes.items():
                known[name] = self.mixed(known[name], text, known)
        if self.hidden.inputs or self.hidden.parameters:
            known |= {output: _evaluate(text, known) for output, text in self.readings.items()}
        return known

    def mixed(self, plain: Any, text: str | None, known: Mapping[str, Any]) -> Any:
        """Return the mixture of a value and its replacement, according to the share."""
        if text is None:
            return plain
        return plain + self.share * (_evaluate(text, known) - plain)

    def declared(self, time: float, x: Array, n: int | None = None) -> dict[str, Any]:
        """Return the values of all names of the declared model, and of the hidden states."""
        known = dict(zip(self.states, x, strict=False))
        known.update(zip(self.system.inputs, self.between(self.inputs, time, n), strict=True))
        known.update(self.values)
        known |= {output: _evaluate(text, known) for output, text in self.readings.items()}
        return known

    def past(self, time: float) -> Array:
        """Return all states at an earlier time."""
        if time <= 0.0:
            return self.first
        n = min(int(time / self.system.interval), len(self.steps) - 1)
        return np.asarray(self.steps[n](time).reshape(self.first.shape))

    def between(self, samples: Array, time: float, n: int | None) -> Array:
        """Return linear interpolation between samples, within the step from sample n."""
        place = time / self.system.interval
        n = min(int(place), len(samples) - 2) if n is None else n
        return np.asarray(samples[n] + (place - n) * (samples[n + 1] - samples[n]))


@cache
def _code(text: str) -> CodeType:
    return compile(text, "equation", "eval")


def _evaluate(text: str, known: Mapping[str, Any]) -> Any:
    return eval(_code(text), FUNCTIONS, known)
