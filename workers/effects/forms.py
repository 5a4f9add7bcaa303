"""The library of forms: each physically named effect as an equation.

In an equation, `v` is the form's variable (`v` and `w` where it has two), `t` the time, `s` the
signal at the site, and every other name one of the form's own parameters or states. At a state
derivative the equation is what is added to it; at an input, output or parameter it is what takes
the place of `s`. With its coefficients at their neutral values a form does nothing.

A form of your own is one entry here, or an expression in a config.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from workers.description import nearest
from workers.errors import EffectError

SiteKind = Literal["derivative", "input", "output", "parameter"]


@dataclass(frozen=True)
class Coefficient:
    """A parameter of a form.

    Attributes
    ----------
    name
        As in the equation.
    neutral
        The value at which the effect does nothing, whatever the shape parameters are. None for a
        shape parameter: a threshold, a width, a frequency.
    positive
        Whether physics wants it positive.
    """

    name: str
    neutral: float | None = 0.0
    positive: bool = False


@dataclass(frozen=True)
class OwnState:
    """A state that a form brings along: its derivative and its value at the start."""

    name: str
    derivative: str
    start: str


@dataclass(frozen=True)
class Form:
    """One physically named effect.

    Attributes
    ----------
    name, family
        "coulomb", "friction".
    kinds
        Sites at which it makes sense.
    equation
        See the module's docstring.
    coefficients
        Its own parameters.
    variables
        How many variables it is a function of: 0, 1 or 2.
    states
        Its own states.
    delay
        Name of the coefficient that is a pure delay of the signal at the site; the equation then
        is "s".
    """

    name: str
    family: str
    kinds: tuple[SiteKind, ...]
    equation: str
    coefficients: tuple[Coefficient, ...]
    variables: int = 0
    states: tuple[OwnState, ...] = ()
    delay: str = ""


def _shape(name: str) -> Coefficient:
    return Coefficient(name, None, positive=True)


_DER: tuple[SiteKind, ...] = ("derivative",)
_IN: tuple[SiteKind, ...] = ("input",)
_OUT: tuple[SiteKind, ...] = ("output",)
_SIGNAL: tuple[SiteKind, ...] = ("input", "output")
_PAR: tuple[SiteKind, ...] = ("parameter",)
_K = (Coefficient("k"),)
_DRAG = (Coefficient("k", positive=True),)
_LAG = OwnState("z", "(v - z) / tau", "v")

_ALL = (
    # loads
    Form("constant", "load", _DER, "k", _K),
    Form("drift", "load", _DER, "k * t", _K),
    Form("sine", "load", _DER, "a * sin(f * t) + b * cos(f * t)",
         (Coefficient("a"), Coefficient("b"), _shape("f"))),
    # friction and drag: they take energy out where v is a velocity
    Form("viscous", "friction", _DER, "-k * v", _DRAG, 1),
    Form("quadratic", "drag", _DER, "-k * v * abs(v)", _DRAG, 1),
    Form("cubic", "drag", _DER, "-k * v^3", _DRAG, 1),
    Form("coulomb", "friction", _DER, "-k * tanh(v / width)", (*_DRAG, _shape("width")), 1),
    Form("stribeck", "friction", _DER, "-k * exp(-(v / vs)^2) * tanh(v / width)",
         (*_DRAG, _shape("vs"), _shape("width")), 1),
    Form("dahl", "friction", _DER, "-k * z", (*_DRAG, _shape("x0")), 1,
         (OwnState("z", "(v - abs(v) * z) / x0", "0"),)),
    # couplings and stiffness
    Form("linear", "coupling", _DER, "k * v", _K, 1),
    Form("square", "stiffness", _DER, "k * v^2", _K, 1),
    Form("product", "coupling", _DER, "k * v * w", _K, 2),
    Form("lagged", "coupling", _DER, "k * z", (*_K, _shape("tau")), 1, (_LAG,)),
    Form("hinge", "end stop", _DER, "k * max(v - at, 0)", (*_K, Coefficient("at", None)), 1),
    Form("hinge_below", "end stop", _DER, "k * max(at - v, 0)", (*_K, Coefficient("at", None)), 1),
    Form("gap", "end stop", _DER, "-k * (max(v - at, 0) - max(-v - at, 0))",
         (*_DRAG, _shape("at")), 1),
    Form("square_root", "leak", _DER, "-k * sqrt(max(v, 0))", _K, 1),
    # an input that is not what was commanded
    Form("bias", "offset", _SIGNAL, "s + k", _K),
    Form("drift", "offset", _SIGNAL, "s + k * t", _K),
    Form("gain", "gain", _SIGNAL, "s * (1 + k)", _K),
    Form("square", "nonlinearity", _SIGNAL, "s + k * s^2", _K),
    Form("cubic", "nonlinearity", _IN, "s + k * s^3", _K),
    Form("asymmetry", "nonlinearity", _IN, "s + k * max(s, 0)", _K),
    Form("dead_zone", "nonlinearity", _IN, "where(abs(s) > k, s - k * sign(s), 0)", _DRAG),
    Form("saturation", "limit", _SIGNAL, "max(min(s, limit), -limit)",
         (Coefficient("limit", float("inf"), positive=True),)),
    Form("product", "nonlinearity", _IN, "s + k * s * v", _K, 1),
    Form("lag", "lag", _SIGNAL, "z", (Coefficient("tau", positive=True),), 0,
         (OwnState("z", "(s - z) / tau", "s"),)),
    Form("delay", "delay", _SIGNAL, "s", (Coefficient("tau", positive=True),), delay="tau"),
    # a sensor
    Form("absolute", "nonlinearity", _OUT, "s + k * abs(s)", _K),
    Form("feed_through", "coupling", _OUT, "s + k * v", _K, 1),
    Form("lagged_feed_through", "coupling", _OUT, "s + k * z", (*_K, _shape("tau")), 1, (_LAG,)),
    Form("hum", "disturbance", _OUT, "s + a * sin(f * t) + b * cos(f * t)",
         (Coefficient("a"), Coefficient("b"), _shape("f"))),
    # a parameter that varies; centred, or it would hide behind the parameter itself
    Form("drift", "variation", _PAR, "s * (1 + k * (t - at))", (*_K, Coefficient("at", None))),
    Form("linear", "variation", _PAR, "s * (1 + k * (v - at))", (*_K, Coefficient("at", None)), 1),
    Form("magnitude", "variation", _PAR, "s * (1 + k * (abs(v) - at))",
         (*_K, Coefficient("at", None)), 1),
    Form("square", "variation", _PAR, "s * (1 + k * (v^2 - at))",
         (*_K, Coefficient("at", None)), 1),
    Form("heating", "variation", _PAR, "s * (1 + k * (z - at))",
         (*_K, Coefficient("at", None), _shape("tau")), 1,
         (OwnState("z", "(v^2 - z) / tau", "0"),)),
)  # fmt: skip

FORMS: dict[tuple[SiteKind, str], Form] = {(kind, f.name): f for f in _ALL for kind in f.kinds}
"""By kind of site and name."""


def form(kind: SiteKind, name: str, where: str) -> Form:
    """Look up a form.

    Raises
    ------
    EffectError
        If there is none of that name for that kind of site.
    """
    if (kind, name) not in FORMS:
        known = [n for k, n in FORMS if k == kind]
        raise EffectError(
            f"{where}: there is no form {name!r} for a site of kind {kind}{nearest(name, known)}"
        )
    return FORMS[kind, name]
