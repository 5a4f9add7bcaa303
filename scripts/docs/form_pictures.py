"""The picture of the forms: what each makes of a signal, or adds, by the library's equations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import sympy as sp
from docs.svg import document

from cluster_est.closed_loop.candidates.array_forms import own_states_of
from workers.effects.expression import parse
from workers.effects.forms import FORMS, EffectForm
from workers.effects.signal_memory import MEMORIES, SampledSignal
from workers.messages import FloatArray

COLUMNS, TILE, DRAWN, HEAD = 8, 104, 84, 34

STYLE = """
text { font-size: 11px; text-anchor: middle; }
.head { font-size: 13px; text-anchor: start; }
.given { stroke: var(--edge); stroke-width: 1.2; stroke-dasharray: 3 3; fill: none; }
"""

Values = Mapping[str, float]

ARGUMENTS = ("t", "s", "v", "w")
SWITCH = {"width": 0.03}
ADDED: dict[str, Values] = {
    "viscous": {"k": 1.0},
    "quadratic": {"k": 1.0},
    "cubic": {"k": 1.0},
    "power": {"k": 1.0, "n": 0.5, "ref": 1.0},
    "coulomb": {"k": 0.8, **SWITCH},
    "asymmetric_coulomb": {"forward": 0.9, "backward": 0.5, **SWITCH},
    "stribeck": {"k": 0.5, "peak": 0.5, "vs": 0.2, **SWITCH},
    "signed_root": {"k": 1.0},
    "saturating": {"k": 1.2, "half": 0.25},
    "hill_power": {"k": 1.0, "half": 0.4, "n": 4.0},
    "exponential": {"k": 1.0, "at": 1.0, "width": 0.3},
    "hinge": {"k": 1.5, "at": 0.3},
    "hinge_below": {"k": 1.5, "at": -0.3},
    "contact": {"k": 1.0, "at": 0.0, "n": 2.0, "ref": 1.0},
    "gap": {"k": 2.0, "at": 0.5},
    "periodic": {"a": 0.8, "b": 0.0, "n": 12.0},
    "square": {"k": 1.0},
}
"""At a state derivative, over the form's variable."""

CHARACTERISTICS: dict[str, Values] = {
    "dead_zone": {"k": 0.3},
    "cut_off": {"k": 0.3, "width": 0.01},
    "saturation": {"limit": 0.6},
    "asymmetry": {"k": -0.5},
    "gain": {"k": -0.4},
    "square": {"k": 0.3},
    "cubic": {"k": -0.5},
    "power_characteristic": {"n": 0.5, "ref": 1.0},
    "saturating": {"k": 1.0},
}
"""At an input or an output, over the signal there; dashed: without the form."""

RESPONSES: dict[tuple[str, str], Values] = {
    ("input", "lag"): {"tau": 0.12},
    ("input", "mode"): {"f": 40.0, "d": 0.25},
    ("input", "delay"): {"tau": 0.15},
    ("input", "rate_limit"): {"rate": 2.5},
    ("input", "lead"): {"k": 0.25, "tau": 0.12},
    ("output", "lagged_feed_through"): {"k": 0.5, "tau": 0.15},
    ("output", "mode_feed_through"): {"a": 0.5, "b": 0.0, "f": 40.0, "d": 0.1},
    ("derivative", "store"): {"k": 1.0, "tau": 0.15},
}
"""Of a step, over time; the last ones are what a step of another signal adds."""

LOOPS: dict[tuple[str, str], Values] = {
    ("input", "backlash"): {"k": 0.3},
    ("derivative", "dahl"): {"k": 0.8, "x0": 0.02},
    ("output", "hysteresis"): {"k": 0.8, "x0": 0.02},
}
"""Of what goes to and fro: over the signal, and over the travel of the variable."""

FACTORS: dict[str, Values] = {
    "linear": {"k": 0.5, "at": 0.0},
    "magnitude": {"k": 0.8, "at": 0.5},
    "square": {"k": 0.8, "at": 0.3},
    "saturating": {"k": 0.8, "half": 0.25},
    "hill": {"k": 0.9, "half": 0.3},
    "inverse": {"k": 0.4, "at": 0.2},
    "inverse_square": {"k": 1.0, "at": 0.2},
    "exponential": {"k": 0.8, "at": 0.5},
}
"""Of a parameter, over the form's variable; dashed: the parameter without the form."""


@dataclass(frozen=True)
class Tile:
    """The shape of one form: a line, and beside it what there is without the form."""

    name: str
    x: FloatArray
    y: FloatArray
    without: FloatArray | None = None


def picture() -> str:
    """All groups of shapes as SVG."""
    parts, top = [], 0.0
    for title, tiles in groups():
        parts.append(f'<text class="head" x="8" y="{top + 22:.0f}">{title}</text>')
        top += HEAD
        for number, tile in enumerate(tiles):
            row, column = divmod(number, COLUMNS)
            parts.append(drawn(tile, TILE * column, top + TILE * row))
        top += TILE * -(-len(tiles) // COLUMNS)
    size = TILE * COLUMNS + 8, round(top + 8)
    return document(size, "Shapes of the forms of effects", STYLE, parts)


def groups() -> list[tuple[str, list[Tile]]]:
    """The groups of the picture, each with its title."""
    moved = np.linspace(-1.0, 1.0, 101)
    times = np.linspace(0.0, 1.0, 161)
    step = np.where(times >= 0.1, 0.8, 0.0)
    there = 0.9 * np.sin(2.0 * np.pi * 1.25 * times)
    travel = -0.9 * np.cos(2.0 * np.pi * 1.25 * times)
    one = np.ones_like(moved)
    return [
        (
            "Added to a state derivative, over the variable",
            [_shape("derivative", n, v, moved, x=moved) for n, v in ADDED.items()],
        ),
        (
            "An input or output, over the signal; dashed: without the form",
            [_shape("input", n, v, moved, moved) for n, v in CHARACTERISTICS.items()],
        ),
        (
            "After a step, over time; over the signal, and over travel, to and fro",
            [
                _shape(site, n, v, step, step if n in FOLLOWING else 0.0 * step, x=2.0 * times - 1)
                for (site, n), v in RESPONSES.items()
            ]
            + [
                _shape(site, n, v, there, there, dashed=False)
                if n in FOLLOWING
                else _shape(site, n, v, there, x=travel)
                for (site, n), v in LOOPS.items()
            ],
        ),
        (
            "A parameter, over the variable; dashed: without the form",
            [_shape("parameter", n, v, moved, one, offset=-0.5) for n, v in FACTORS.items()],
        ),
    ]


FOLLOWING = ("lag", "lead", "mode", "delay", "rate_limit", "backlash")
"""What changes the signal at its site, and does not add a function of another one."""


def _shape(
    site: str,
    name: str,
    values: Values,
    variable: FloatArray,
    signal: FloatArray | None = None,
    *,
    x: FloatArray | None = None,
    dashed: bool = True,
    offset: float = 0.0,
) -> Tile:
    """What a form makes of a signal, or what it adds without a signal."""
    times = np.linspace(0.0, 1.0, len(variable))
    before = np.zeros_like(variable) if signal is None else signal
    after = evaluated(FORMS[site, name], values, (times, before, variable, variable))  # type: ignore[index]
    without = before + offset if signal is not None and dashed else None
    return Tile(name, variable if x is None else x, after + offset, without)


def evaluated(form: EffectForm, values: Values, signals: tuple[FloatArray, ...]) -> FloatArray:
    """The equation of a form along the signals t, s, v and w."""
    numbers = [values[c.name] for c in form.coefficients]
    if form.memory:
        changed = MEMORIES[form.memory](SampledSignal(signals[0], signals[1]), numbers[0])
        return np.asarray(np.interp(signals[0], changed.times, changed.values))
    states, coefficients = [z.name for z in form.states], [c.name for c in form.coefficients]
    symbols = {n: sp.Symbol(n, real=True) for n in [*ARGUMENTS, *states, *coefficients]}
    equation = parse(form.equation, symbols, f"form {form.name}")
    function = sp.lambdify(list(symbols.values()), equation, "numpy")
    own = own_states_of(form, ARGUMENTS, symbols, f"form {form.name}")
    found = function(*signals, *own.follow(signals, tuple(numbers)), *numbers)
    return np.asarray(np.broadcast_to(found, len(signals[0])), float)


def drawn(tile: Tile, left: float, top: float) -> str:
    """A tile with its axes and its name."""
    across, middle = left + TILE / 2, top + DRAWN / 2

    def path(y: FloatArray, kind: str) -> str:
        points = zip(tile.x, np.clip(y, -1.0, 1.0), strict=True)
        steps = (f"{across + 42.0 * a:.1f} {middle - 36.0 * b:.1f}" for a, b in points)
        return f'<path class="{kind}" d="M{"L".join(steps)}"/>'

    parts = [
        f'<path class="rule" d="M{across - 44} {middle}h88M{across} {middle - 38}v76"/>',
        "" if tile.without is None else path(tile.without, "given"),
        path(tile.y, "line c0"),
        f'<text x="{across}" y="{top + TILE - 8:.0f}">{tile.name}</text>',
    ]
    return "\n".join(part for part in parts if part)
