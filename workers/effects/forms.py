"""The library of forms: each is an equation with a name from physics or mathematics.

In an equation, `v` is the form's variable (`v` and `w` if it has two), `t` is the time, and `s` is
the signal at the site. Every other name is a coefficient or an internal state of the form. At a
state derivative, the equation is added to the derivative. At a pair of derivatives, it is added to
the first one, and a reaction is added to the second one. At an input, an output or a parameter, the
equation replaces `s`. If all coefficients have their neutral values, a form does nothing.

To use your own form, add an entry here, or write an expression in a config.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from workers.effects.kinds import (
    FREE_FAMILY,
    NOISE_FAMILY,
    EffectForm,
    FormCoefficient,
    FormCondition,
    GridScale,
    OwnState,
    SiteKind,
    positive,
)
from workers.effects.laws import Law
from workers.effects.stores import STORES
from workers.errors import EffectError
from workers.fmu.description import nearest

__all__ = [
    "FORMS",
    "EffectForm",
    "FormCoefficient",
    "FormCondition",
    "GridScale",
    "OwnState",
    "SiteKind",
    "form",
    "other_forms",
    "positive",
]

_DER: tuple[SiteKind, ...] = ("derivative",)
_PAIR: tuple[SiteKind, ...] = ("pair",)
_IN: tuple[SiteKind, ...] = ("input",)
_OUT: tuple[SiteKind, ...] = ("output",)
_SIGNAL: tuple[SiteKind, ...] = ("input", "output")
_PAR: tuple[SiteKind, ...] = ("parameter",)

_OSCILLATES = (FormCondition.OSCILLATES,)
_OWN = (FormCondition.OWN,)
_OWN_OSCILLATES = (FormCondition.OWN, FormCondition.OSCILLATES)
_DRIVEN = (FormCondition.DRIVEN,)
_REVERSES = (FormCondition.REVERSES,)
_DRIVEN_OSCILLATES = (FormCondition.DRIVEN, FormCondition.OSCILLATES)
_DIFFERENCE_OSCILLATES = (FormCondition.DIFFERENCE, FormCondition.OSCILLATES)


def _k(unit: str) -> FormCoefficient:
    return FormCoefficient("k", unit=unit)


def _drag(unit: str, *, name: str = "k", if_own: bool = False) -> FormCoefficient:
    """Return a strength of an effect that takes energy out of the system."""
    return FormCoefficient(name, positive=True, if_own=if_own, unit=unit)


def _shape(name: str, unit: str, scale: GridScale, *grid: float) -> FormCoefficient:
    return FormCoefficient(name, None, positive=True, scale=scale, grid=grid, unit=unit)


def _at(unit: str, scale: GridScale, *grid: float, held: bool = False) -> FormCoefficient:
    """Return a position on the axis of the variable, which may be negative."""
    return FormCoefficient("at", None, scale=scale, grid=grid, held=held, unit=unit)


def _centre(unit: str, scale: GridScale) -> FormCoefficient:
    """Return a fixed reference point at which a parameter has its own value; it is not fitted."""
    return _at(unit, scale, 1.0, held=True)


def _limit(neutral: float, scale: GridScale, *grid: float) -> FormCoefficient:
    return FormCoefficient("limit", neutral, scale=scale, grid=grid, unit="site")


def _tau(*steps: float) -> FormCoefficient:
    return _shape("tau", "second", GridScale.STEP, *steps)


def _wave(unit: str, number: FormCoefficient) -> tuple[FormCoefficient, ...]:
    """Return the coefficients of a wave: a for the sine, b for the cosine, and the wave number."""
    return FormCoefficient("a", unit=unit), FormCoefficient("b", unit=unit), number


_FREQUENCY = _shape("f", "rad / second", GridScale.SPECTRUM, 1.0)
_WITHIN = _at("v", GridScale.QUANTILE_V, 0.15, 0.3, 0.5, 0.7, 0.85)
_WIDTH = FormCoefficient(
    "width", None, positive=True, scale=GridScale.RMS_V, grid=(0.004, 0.0005), held=True, unit="v"
)
"""Width of a switch: the smallest width that a solver can still resolve."""
_NARROW = replace(_WIDTH, grid=(0.004,))
_EDGE = FormCoefficient(
    "width", None, positive=True, scale=GridScale.MAX_S, grid=(0.005,), held=True, unit="site"
)
"""Width of the jump of a signal that is cut off; a sharp jump would have no gradient for a fit."""
_WAVE = _wave("site", _FREQUENCY)
_WAVES = tuple(0.5 * halves for halves in range(3, 33))
"""Numbers of waves within the range of the data. Steps of 0.5 miss no peak of a periodogram."""
_BEYOND = _shape("at", "v", GridScale.MAX_V, 0.35, 0.55, 0.75)
_HALF = _shape("half", "v", GridScale.MAX_V, 0.1, 0.3, 1.0)
"""Value at which half of the limit is reached, as in the Michaelis-Menten law."""
_HILL = _shape("n", "1", GridScale.EXPONENT, 3.0)
"""Hill's exponent. Exponent 1 and, for a parameter, exponent 2 have their own forms."""
_REFERENCE = FormCoefficient(
    "ref", None, positive=True, scale=GridScale.MAX_V, grid=(1.0,), held=True, unit="v"
)
"""Reference of a power law: at this value, the term equals its strength for any exponent."""
_EXPONENT_OF_POWER = _shape("n", "1", GridScale.EXPONENT, 0.7, 1.5, 2.5, 4.5)
"""Exponents of a power law. The square root, the linear term, the square and the cube have their
own forms."""
_ZERO = FormCoefficient(
    "zero", None, scale=GridScale.ABSOLUTE_ZERO, grid=(1.0,), held=True, unit="v"
)
_LATE = FormCoefficient(
    "tau", positive=True, scale=GridScale.STEP, grid=(1.0, 4.0, 12.0), unit="second"
)
_QUICK = FormCoefficient(
    "tau", None, positive=True, scale=GridScale.STEP, grid=(0.1,), held=True, unit="second"
)
"""Lag of a signal that stands for the signal itself: much shorter than what the data show, but not
so short that a solver must take many more steps."""
_COLOURED = (
    FormCoefficient("q", positive=True, unit="site / second^0.5"),
    _shape("tau", "second", GridScale.STEP, 10.0),
)
_LEVEL = FormCoefficient(
    "k", positive=True, scale=GridScale.MAX_S, grid=(0.05, 0.12, 0.25), unit="site"
)
_RATE = FormCoefficient(
    "rate",
    float("inf"),
    positive=True,
    scale=GridScale.FASTEST_S,
    grid=(0.8, 0.5, 0.25, 0.1, 0.04, 0.015, 0.005),
    unit="site / second",
)
_SWINGS = (
    FormCoefficient("f", float("inf"), positive=True, scale=GridScale.PER_STEP,
                    grid=(0.5, 0.15, 0.05), unit="rad / second"),
    _shape("d", "1", GridScale.NUMBER, 0.2, 0.7),
)  # fmt: skip
_PULLED = "f * (s - z) - 2 * d * f * y"
_LAG = OwnState("z", "(v - z) / tau", "v")
_RESTING = OwnState("z", "(v - z) / tau", "0")
"""A lag of a quantity that was zero before the start, such as another branch in an electrical
model."""
_DELAY_LINE = (
    OwnState("z", "10 * y / tau", "v"),
    OwnState("y", "10 * q / tau", "0"),
    OwnState("q", "10 * p / tau", "0"),
    OwnState("p", "(0.84 * (v - z) - 4.8 * y - 12 * q - 16 * p) / tau", "0"),
)
_DELAYED = "(z - 30 / 7 * y + 50 / 7 * q - 100 / 21 * p)"
"""The variable delayed by tau; before the start, it has its initial value. exp(-x) is replaced by
its Pade approximant of orders 3 and 4, with D(x) z = v, y = x z / 10, q = x y / 10, p = x q / 10:

    N = 1 - 3/7 x + x^2/14 - x^3/210,    D = 1 + 4/7 x + x^2/7 + 2/105 x^3 + x^4/840

E. Hairer, G. Wanner, Solving Ordinary Differential Equations II (1996), theorem IV.3.12. For a wave
with tau w = 2 radians within the delay, the error is 2e-4 of the amplitude; with pi radians, 0.007.
There is no direct feed-through, so a state may depend on its own delayed value."""
_TRAVEL = OwnState("z", "v", "0")
_BRISTLE = OwnState("z", "(v - abs(v) * z) / x0", "0")
_BENT = (
    OwnState("y", "(s - y) / tau", "s"),
    OwnState("z", "(s - y - abs(s - y) * z) / tau / max(x0, abs(s - y) / 5)", "0"),
)
"""Hysteresis of a signal, z' = (y' - |y'| z) / x0 (P. Dahl, AIAA J. 14 (1976) 1675-1682,
doi:10.2514/3.61511), which is also the law of Bouc and Wen with exponent 1. A form does not know
the rate of its signal, so y follows the signal within a fraction of a step. A lag never overshoots,
so even after a jump y goes the way of the signal, and z depends only on this way. After a jump of
many x0, z is within 1 % of its end when y has gone 5 x0; its rate is limited to 5 / tau, because
with a fixed step a faster one grows without bound."""

_VALUES = 7
"""Number of values of a free curve. Finer curves have two and four times as many steps between
them."""
_FINER = (13, 25)


def _curve(argument: str, values: Iterable[int], of: int = _VALUES) -> str:
    """Return a piecewise linear curve with equidistant values; missing values are 0.

    It is constant below `low` and above `high`.
    """
    inside = f"{of - 1}*(max(min({argument},high),low)-low)/(high-low)"
    return " + ".join(f"k{i} * max(1 - abs({inside} - {i - 1}), 0)" for i in values)


def _curve_coefficients(
    values: Iterable[int], *ends: FormCoefficient, unit: str = "site"
) -> tuple[FormCoefficient, ...]:
    return (*(FormCoefficient(f"k{i}", unit=unit) for i in values), *ends)


def _resolutions(name: str) -> list[tuple[str, int, str]]:
    """Return (name, number of values, name of the next coarser curve) of all resolutions."""
    names = [name, *(f"{name}_{of}" for of in _FINER)]
    return list(zip(names, (_VALUES, *_FINER), ("", *names), strict=False))


def _all(of: int) -> list[int]:
    return list(range(1, of + 1))


def _inside(of: int) -> list[int]:
    """Return all points except both ends, so that a curve of a signal has neither offset nor gain.

    Parameters often have the same influence as offset and gain, which have their own forms.
    """
    return _all(of)[1:-1]


def _around(of: int) -> list[int]:
    """Return all points except the middle one, at which a parameter has its own value.

    With a value in the middle, the curve and the parameter could not be distinguished.
    """
    return [i for i in _all(of) if i != of // 2 + 1]


_MOSTLY = (
    FormCoefficient("low", None, scale=GridScale.LOW_V, grid=(1.0,), held=True, unit="v"),
    FormCoefficient("high", None, scale=GridScale.HIGH_V, grid=(1.0,), held=True, unit="v"),
)
_WHOLLY = (
    FormCoefficient("low", None, scale=GridScale.RANGE_S, grid=(0.0,), held=True, unit="site"),
    FormCoefficient("high", None, scale=GridScale.RANGE_S, grid=(1.0,), held=True, unit="site"),
)
_ACROSS = (
    FormCoefficient("low", None, scale=GridScale.LOW_W, grid=(1.0,), held=True, unit="w"),
    FormCoefficient("high", None, scale=GridScale.HIGH_W, grid=(1.0,), held=True, unit="w"),
)
_RATIO = FormCoefficient(
    "back", None, positive=True, scale=GridScale.COUPLING, grid=(1.0,), unit="other / site"
)


def _between(
    name: str,
    family: str,
    law: Law,
    equation: str,
    unit: str,
    *shapes: FormCoefficient,
    when: tuple[FormCondition, ...] = _OSCILLATES,
    order: float = 0.0,
) -> EffectForm:
    """Return a force between two states: what is taken from the first is given to the second.

    There are two strengths, because the FMU's states may have different inertias.
    """
    strengths = (_drag(f"site{unit}"), _drag(f"other{unit}", name="back"))
    return EffectForm(name, family, law, _PAIR, f"-k * {equation}", (*strengths, *shapes), 1,
                reaction=f"back * {equation}", when=when, order=order)  # fmt: skip


_RATES = (
    # loads
    EffectForm("constant", "load", Law.CONSTANT, _DER, "k", (_k("site"),)),
    EffectForm("drift", "load", Law.DRIFT, _DER, "k * t", (_k("site / second"),)),
    EffectForm("sine", "load", Law.WAVE, _DER, "a * sin(f * t) + b * cos(f * t)", _WAVE),
    # as a function of an angle or a distance: cogging, eccentricity, teeth; without such a state,
    # as a
    # function of the distance travelled
    EffectForm("periodic", "ripple", Law.PERIODIC, _DER, "a * sin(n * v) + b * cos(n * v)",
         _wave("site", _shape("n", "rad / v", GridScale.WAVES_V, *_WAVES)), 1,
         when=(FormCondition.POSITION,), order=1.5),
    EffectForm("periodic_travel", "ripple", Law.PERIODIC_TRAVEL, _DER,
         "a * sin(n * z) + b * cos(n * z)",
         _wave("site", _shape("n", "rad / travel", GridScale.WAVES_TRAVEL_V, *_WAVES)), 1,
         (_TRAVEL,), when=(FormCondition.OWN, FormCondition.NO_POSITION), order=1.5),
    # friction and drag: they take energy out if v is a velocity
    EffectForm("viscous", "friction", Law.LINEAR, _DER,
         "-k * v", (_drag("site / v"),), 1, when=_OWN),
    EffectForm("quadratic", "drag", Law.ODD_SQUARE, _DER, "-k * v * abs(v)",
         (_drag("site / v^2", if_own=True),), 1, when=_OSCILLATES),
    EffectForm("cubic", "drag", Law.CUBE, _DER, "-k * v^3", (_drag("site / v^3", if_own=True),), 1,
         order=0.5),
    EffectForm("power", "drag", Law.POWER, _DER, "-k * sign(v) * (abs(v) / ref)^n",
         (_drag("site", if_own=True), _EXPONENT_OF_POWER, _REFERENCE), 1, order=1.0),
    EffectForm("coulomb", "friction", Law.SWITCH, _DER, "-k * tanh(v / width)",
         (_drag("site"), _WIDTH), 1, when=_OWN_OSCILLATES),
    EffectForm("stribeck", "friction", Law.SWITCH_WITH_PEAK, _DER,
         "-(k + peak * exp(-(v / vs)^2)) * tanh(v / width)",
         (_drag("site"), _drag("site", name="peak"), _shape("vs", "v", GridScale.RMS_V, 0.1, 0.3),
          _WIDTH),
         1, when=_OWN_OSCILLATES),
    EffectForm("asymmetric_coulomb", "friction", Law.TWO_SWITCHES, _DER,
         "-(forward * max(tanh(v / width), 0) + backward * min(tanh(v / width), 0))",
         (_drag("site", name="forward"), _drag("site", name="backward"), _WIDTH),
         1, when=_OWN_OSCILLATES, order=0.5),
    # friction in proportion to a load, such as in a brake or a seal
    EffectForm("load_dependent_coulomb", "friction", Law.SWITCH_BY_MAGNITUDE, _DER,
         "-k * abs(w) * tanh(v / width)",
         (_drag("site / w"), _WIDTH), 2, when=_OWN_OSCILLATES, order=0.6),
    EffectForm("dahl", "friction", Law.HYSTERESIS, _DER, "-k * z",
         (_drag("site"), _shape("x0", "travel", GridScale.TRAVEL_V, 0.02, 0.1, 0.4)), 1,
         (_BRISTLE,),
         when=_OWN_OSCILLATES),
    # couplings and stiffness
    EffectForm("linear", "coupling", Law.LINEAR, _DER, "k * v", (_k("site / v"),), 1, order=0.3),
    EffectForm("square", "stiffness", Law.SQUARE, _DER,
         "k * v^2", (_k("site / v^2"),), 1, order=0.5),
    EffectForm("product", "coupling", Law.PRODUCT, _DER,
         "k * v * w", (_k("site / (v w)"),), 2, order=0.7),
    # for an amount; with both signs it differs little from a Coulomb friction with a soft edge
    EffectForm("saturating", "coupling", Law.SATURATING, _DER, "k * v / (half + abs(v))",
         (_k("site"), _HALF), 1, when=(FormCondition.POSITIVE,), order=1.0),
    EffectForm("hill_power", "coupling", Law.HILL_POWER, _DER,
         "k * max(v, 0)^n / (half^n + max(v, 0)^n)",
         (_k("site"), _HALF, _HILL), 1, when=(FormCondition.POSITIVE,), order=1.2, later=True),
    # for a flow and what it carries, two reactants, or a valve and the pressure across it
    EffectForm("power_product", "coupling", Law.PRODUCT_OF_POWERS, _DER,
         "k * sign(v) * (abs(v) / ref)^m * (abs(w) / other)^n",
         (_k("site"), _shape("m", "1", GridScale.EXPONENT, 0.5, 1.0, 2.0),
          _shape("n", "1", GridScale.EXPONENT, 0.5, 1.0, 2.0), _REFERENCE,
          FormCoefficient("other", None, positive=True, scale=GridScale.MAX_W, grid=(1.0,),
                          held=True, unit="w")),
         2, order=1.1, later=True),
    # between a state and its surroundings, or between two states
    EffectForm("radiation", "radiation", Law.FOURTH_DIFFERENCE, _DER,
         "-k * ((v + zero)^4 - (w + zero)^4)",
         (_drag("site / v^4"), _ZERO), 2, when=(FormCondition.AROUND,), order=0.6),
    EffectForm("radiation", "radiation", Law.FOURTH_DIFFERENCE, _PAIR,
         "-k * ((v + zero)^4 - (w + zero)^4)",
         (_drag("site / v^4"), _drag("other / v^4", name="back"), _ZERO), 2,
         reaction="back * ((v + zero)^4 - (w + zero)^4)", when=(FormCondition.AROUND,), order=0.6),
    # for a diode, or an exothermic chemical reaction
    EffectForm("exponential", "coupling", Law.EXPONENTIAL, _DER, "k * exp((v - at) / width)",
         (_k("site"), _at("v", GridScale.HIGH_V, 1.0, held=True),
          _shape("width", "v", GridScale.RMS_V, 0.15, 0.5)), 1, order=1.2),
    EffectForm("arrhenius", "coupling", Law.ARRHENIUS, _DER,
         "k * exp(E * (1 / (at + zero) - 1 / (v + zero)))",
         (_k("site"), _shape("E", "v", GridScale.KELVIN, 3000.0, 10000.0),
          _at("v", GridScale.HIGH_V, 1.0, held=True), _ZERO), 1, order=1.1, later=True),
    EffectForm("lagged", "coupling", Law.LAGGED, _DER,
         "k * z", (_k("site / v"), _tau(4.0, 15.0, 50.0)), 1,
         (_LAG,),
         when=(FormCondition.OTHER,), order=0.3, differences=True),
    # for a recycle, a belt or a pipe; also for the state itself
    EffectForm("delayed", "coupling", Law.DELAYED, _DER,
         f"k * {_DELAYED}", (_k("site / v"), _tau(4.0, 15.0, 50.0)), 1, _DELAY_LINE,
         order=0.4, differences=True, later=True),
    # for a relay that compares two states; of a single state it would imitate friction elsewhere
    EffectForm("switch", "coupling", Law.SWITCH, _DER, "k * tanh(v / width)",
         (_k("site"), _NARROW), 1, when=_DIFFERENCE_OSCILLATES, order=0.5, differences=True),
    EffectForm("hinge", "end stop", Law.ABOVE, _DER, "k * max(v - at, 0)",
         (_k("site / v"), _at("v", GridScale.QUANTILE_V, 0.5, 0.6, 0.7, 0.8, 0.9)), 1, order=1.0),
    EffectForm("hinge_below", "end stop", Law.BELOW, _DER, "k * max(at - v, 0)",
         (_k("site / v"), _at("v", GridScale.QUANTILE_V, 0.1, 0.2, 0.3, 0.4, 0.5)), 1, order=1.0),
    # for a sphere on a plane (Hertz), or the flow over a weir
    EffectForm("contact", "end stop", Law.ABOVE_BY_POWER, _DER, "k * (max(v - at, 0) / ref)^n",
         (_k("site"), _at("v", GridScale.QUANTILE_V, 0.5, 0.7, 0.85),
          _shape("n", "1", GridScale.EXPONENT, 1.5), _REFERENCE), 1, order=1.3),
    EffectForm("gap", "end stop", Law.GAP, _DER, "-k * (max(v - at, 0) - max(-v - at, 0))",
         (_drag("site / v"), _BEYOND), 1, when=_OSCILLATES),
    EffectForm("square_root", "leak", Law.ROOT, _DER,
         "-k * sqrt(max(v, 0))", (_k("site / v^0.5"),), 1,
         when=(FormCondition.POSITIVE,)),
    EffectForm("signed_root", "leak", Law.ODD_ROOT, _DER, "-k * sign(v) * sqrt(abs(v))",
         (_drag("site / v^0.5", if_own=True),), 1, when=_OSCILLATES),
    *(
        EffectForm(name, FREE_FAMILY, Law.CURVE, _DER, _curve("v", _all(of), of),
             _curve_coefficients(_all(of), *_MOSTLY), 1, order=2.0, values=of, finer_than=coarse)
        for name, of, coarse in _resolutions("table")
    ),
    # a friction whose level depends on the position or on any other variable
    *(
        EffectForm(name, FREE_FAMILY, Law.SWITCH_BY_CURVE, _DER,
             f"-({_curve('w', _all(of), of)}) * tanh(v / width)",
             _curve_coefficients(_all(of), *_ACROSS, _WIDTH), 2, when=_OWN_OSCILLATES, order=2.0,
             values=of, finer_than=coarse)
        for name, of, coarse in _resolutions("coulomb_table")
    ),
    # between two states
    _between("joint", "end stop", Law.CLIPPED, "max(min(v, at), -at)", " / v", _BEYOND),
    _between("gap", "end stop", Law.GAP, "(max(v - at, 0) - max(-v - at, 0))", " / v", _BEYOND),
    _between("hinge", "end stop", Law.ABOVE, "max(v - at, 0)", " / v", _WITHIN, when=(), order=1.0),
    _between("hinge_below", "end stop", Law.BELOW,
             "min(v - at, 0)", " / v", _WITHIN, when=(), order=1.0),
    _between("linear", "coupling", Law.LINEAR, "v", " / v", when=(), order=0.3),
    _between("quadratic", "drag", Law.ODD_SQUARE, "v * abs(v)", " / v^2"),
    _between("cubic", "drag", Law.CUBE, "v^3", " / v^3", when=(), order=0.5),
    _between("power", "drag", Law.POWER,
             "sign(v) * (abs(v) / ref)^n", "", _EXPONENT_OF_POWER, _REFERENCE,
             when=(), order=1.0),
    # for the film of a heat exchanger, or a valve between two tanks
    replace(
        _between("power_times", "coupling", Law.TIMES_POWER, "v * (abs(w) / ref)^n", " / v",
                 _shape("n", "1", GridScale.EXPONENT, 0.5, 1.0, 2.0),
                 replace(_REFERENCE, scale=GridScale.MAX_W, unit="w"),
                 when=(FormCondition.EXCHANGE,), order=0.6),
        variables=2,
    ),
    _between("coulomb", "friction", Law.SWITCH, "tanh(v / width)", "", _WIDTH),
    _between("overflow", "leak", Law.ABOVE, "max(v - at, 0)", " / v",
             _at("v", GridScale.QUANTILE_V, 0.5, 0.6, 0.7, 0.8, 0.9),
             when=(FormCondition.FIRST,), order=0.2),
    _between("leak", "leak", Law.ODD_ROOT, "sign(v) * sqrt(abs(v))", " / v^0.5"),
    # one curve for both states, except for the ratio of their inertias
    *(
        EffectForm(name, FREE_FAMILY, Law.CURVE, _PAIR, _curve("v", _all(of), of),
             _curve_coefficients(_all(of), _RATIO, *_MOSTLY), 1,
             reaction=f"-back * ({_curve('v', _all(of), of)})", order=2.0, values=of,
             finer_than=coarse)
        for name, of, coarse in _resolutions("table")
    ),
)  # fmt: skip

_AS_FORCES = (
    "periodic", "viscous", "quadratic", "power", "coulomb", "stribeck", "asymmetric_coulomb",
    "dahl", "linear", "hinge", "hinge_below", "contact", "gap", "signed_root",
    *(name for name, _, _ in _resolutions("table")),
)  # fmt: skip


def _as_force(law: EffectForm) -> EffectForm:
    """Return a form at an input that acts on several derivatives: a generalised force."""
    sign = " - " if law.equation.startswith("-") else " + "
    return replace(
        law,
        kinds=_IN,
        equation=f"s{sign}{law.equation.removeprefix('-')}",
        coefficients=tuple(replace(c, if_own=c.neutral == 0.0) for c in law.coefficients),
        when=(*law.when, FormCondition.FORCE),
    )


_FORCES = tuple(_as_force(law) for law in _RATES if law.kinds == _DER and law.name in _AS_FORCES)

_AS_TERMS = (
    "quadratic", "power", "coulomb", "stribeck", "asymmetric_coulomb", "product", "exponential",
    "hinge", "hinge_below", "signed_root",
)  # fmt: skip


def _as_term(law: EffectForm) -> EffectForm:
    """Return a function of inputs as an additional term of an output on which they act directly.

    Such an output is a balance, such as the torque that a given motion needs. The sign convention
    of the balance is the model's, so a strength may have either sign.
    """
    when = tuple(w for w in law.when if w is not FormCondition.OWN)
    strengths = tuple(
        replace(c, positive=False, if_own=False) if c.neutral == 0.0 else c
        for c in law.coefficients
    )
    return replace(
        law,
        kinds=_OUT,
        equation=f"s + {law.equation.removeprefix('-')}",
        coefficients=strengths,
        when=(*when, FormCondition.FEEDS),
    )


_TERMS = (
    *(_as_term(law) for law in _RATES if law.kinds == _DER and law.name in _AS_TERMS),
    # named after the laws of a sensor that changes its own signal
    EffectForm("square_feed_through", "coupling", Law.SQUARE, _OUT,
         "s + k * v^2", (_k("site / v^2"),), 1,
         when=(FormCondition.FEEDS,), order=0.5),
    EffectForm("cubic_feed_through", "coupling", Law.CUBE, _OUT,
         "s + k * v^3", (_k("site / v^3"),), 1,
         when=(FormCondition.FEEDS,), order=0.5),
)  # fmt: skip

_SIGNALS = (
    # an input that differs from its command, or a sensor that shows a wrong value
    EffectForm("bias", "offset", Law.OFFSET, _SIGNAL, "s + k", (_k("site"),)),
    EffectForm("drift", "offset", Law.DRIFT, _SIGNAL, "s + k * t", (_k("site / second"),)),
    EffectForm("gain", "gain", Law.GAIN, _SIGNAL, "s * (1 + k)", (_k("1"),)),
    EffectForm("square", "nonlinearity", Law.QUADRATIC_PART, _SIGNAL,
         "s + k * s^2", (_k("1 / site"),), order=0.5),
    EffectForm("cubic", "nonlinearity", Law.CUBIC_PART, _SIGNAL,
         "s + k * s^3", (_k("1 / site^2"),), order=0.5),
    EffectForm("power_characteristic", "nonlinearity", Law.POWER_CHARACTERISTIC, _SIGNAL,
         "sign(s) * ref * (abs(s) / ref)^n",
         (FormCoefficient("n", 1.0, positive=True, scale=GridScale.EXPONENT, grid=(0.7, 1.5, 2.5),
                          unit="1"),
          FormCoefficient("ref", None, positive=True, scale=GridScale.MAX_S, grid=(1.0,),
                          held=True, unit="site")), order=1.0),
    EffectForm("saturating", "nonlinearity", Law.LEVELLING, _SIGNAL, "s / (1 + k * abs(s))",
         (FormCoefficient("k", positive=True, unit="1 / site"),), order=0.8),
    EffectForm("asymmetry", "nonlinearity", Law.ASYMMETRY, _SIGNAL, "s + k * max(s, 0)",
         (_k("1"),), when=_OSCILLATES),
    EffectForm("dead_zone", "nonlinearity", Law.DEAD_ZONE, _SIGNAL,
         "where(abs(s) > k, s - k * sign(s), 0)", (_LEVEL,)),
    EffectForm("cut_off", "nonlinearity", Law.CUT_OFF, _SIGNAL,
         "s * (1 + tanh((abs(s) - k) / width)) / 2", (_LEVEL, _EDGE), order=0.5),
    # for an eccentric encoder or a cam
    EffectForm("periodic", "nonlinearity", Law.PERIODIC_ERROR, _OUT,
         "s + a * sin(n * s) + b * cos(n * s)",
         _wave("site", _shape("n", "rad / site", GridScale.WAVES_V, *_WAVES)), order=1.5),
    # play in a linkage before an actuator's load, or before a sensor
    EffectForm("backlash", "nonlinearity", Law.BACKLASH, _SIGNAL, "s", (_LEVEL,),
         memory="backlash", when=_REVERSES),
    # for piezo actuators, solenoids and valves
    EffectForm("hysteresis", "memory", Law.HYSTERESIS_OF_SIGNAL, _IN, "s + k * z",
         (_k("site"), _shape("x0", "site", GridScale.MAX_S, 0.1, 0.4, 1.5), _QUICK), 0, _BENT,
         when=_REVERSES, order=1.0),
    EffectForm("rate_limit", "limit", Law.RATE_LIMIT, _IN, "s", (_RATE,), memory="rate_limit"),
    EffectForm("rate_limit_from_rest", "limit", Law.RATE_LIMIT_FROM_REST, _IN,
         "s", (_RATE,), memory="rate_limit_from_rest",
         when=(FormCondition.FROM_REST,), order=0.2),
    EffectForm("saturation", "limit", Law.SATURATION, _SIGNAL, "max(min(s, limit), -limit)",
         (FormCoefficient("limit", float("inf"), positive=True, scale=GridScale.MAX_S,
                      grid=(0.95, 0.88, 0.8, 0.7, 0.6, 0.45, 0.3),
                      unit="site"),)),
    EffectForm("clip_above", "limit", Law.LIMIT_ABOVE, _OUT, "min(s, limit)",
         (_limit(float("inf"), GridScale.RANGE_S, 0.95, 0.88, 0.8, 0.7, 0.55),)),
    EffectForm("clip_below", "limit", Law.LIMIT_BELOW, _OUT, "max(s, limit)",
         (_limit(float("-inf"), GridScale.RANGE_S, 0.05, 0.12, 0.2, 0.3, 0.45),)),
    EffectForm("product", "nonlinearity", Law.PRODUCT_WITH_SIGNAL, _IN,
         "s + k * s * v", (_k("1 / v"),), 1, order=0.7),
    EffectForm("lag", "lag", Law.FIRST_ORDER_LAG, _SIGNAL,
         "z", (_LATE,), 0, (OwnState("z", "(s - z) / tau", "s"),)),
    EffectForm("lag_from_rest", "lag", Law.FIRST_ORDER_LAG_FROM_ZERO, _SIGNAL, "z", (_LATE,), 0,
         (OwnState("z", "(s - z) / tau", "0"),), when=(FormCondition.FROM_REST,), order=0.2),
    # for an actuator or a sensor that oscillates, with a static gain of 1
    EffectForm("mode", "lag", Law.SECOND_ORDER_LAG, _SIGNAL, "z", _SWINGS, 0,
         (OwnState("z", "f * y", "s"), OwnState("y", _PULLED, "0")), order=0.8),
    EffectForm("mode_from_rest", "lag", Law.SECOND_ORDER_LAG_FROM_ZERO, _IN, "z", _SWINGS, 0,
         (OwnState("z", "f * y", "0"), OwnState("y", _PULLED, "0")),
         when=(FormCondition.FROM_REST,), order=0.9),
    EffectForm("delay", "delay", Law.DELAY, _SIGNAL, "s", (_LATE,), memory="delay"),
    EffectForm("absolute", "nonlinearity", Law.GAIN_OF_MAGNITUDE, _OUT,
         "s + k * abs(s)", (_k("1"),), when=_OSCILLATES),
    EffectForm("feed_through", "coupling", Law.LINEAR, _OUT,
         "s + k * v", (_k("site / v"),), 1, order=0.3),
    EffectForm("lagged_feed_through", "coupling", Law.LAGGED, _OUT, "s + k * z",
         (_k("site / v"), _tau(4.0, 15.0, 60.0)), 1, (_RESTING,), when=_DRIVEN, order=0.3),
    EffectForm("hysteresis", "memory", Law.HYSTERESIS, _OUT, "s + k * z",
         (_k("site"), _shape("x0", "travel", GridScale.TRAVEL_V, 0.1, 0.4, 1.5)), 1, (_BRISTLE,),
         when=_DRIVEN_OSCILLATES),
    *(
        EffectForm(name, FREE_FAMILY, Law.CHARACTERISTIC, _SIGNAL,
             f"s + {_curve('s', _inside(of), of)}",
             _curve_coefficients(_inside(of), *_WHOLLY), order=2.0, values=of, finer_than=coarse)
        for name, of, coarse in _resolutions("characteristic")
    ),
    # as a function of another variable: a voltage by the charge, a reading by a temperature
    *(
        EffectForm(name, FREE_FAMILY, Law.CURVE, _OUT, f"s + {_curve('v', _all(of), of)}",
             _curve_coefficients(_all(of), *_MOSTLY), 1, order=2.0, values=of, finer_than=coarse)
        for name, of, coarse in _resolutions("table")
    ),
    EffectForm("hum", "disturbance", Law.WAVE, _OUT, "s + a * sin(f * t) + b * cos(f * t)", _WAVE),
)  # fmt: skip

_VARIATIONS = (
    # a parameter that varies; centred, because otherwise the parameter itself would compensate it
    EffectForm("drift", "variation", Law.DRIFT, _PAR, "s * (1 + k * (t - at))",
         (_k("1 / second"), _centre("second", GridScale.MIDDLE_T)), order=1.0),
    EffectForm("sine", "variation", Law.WAVE, _PAR, "s * (1 + a * sin(f * t) + b * cos(f * t))",
         _wave("1", _FREQUENCY), order=1.0),
    EffectForm("linear", "variation", Law.LINEAR, _PAR, "s * (1 + k * (v - at))",
         (_k("1 / v"), _centre("v", GridScale.MEAN_V)), 1, order=0.9),
    EffectForm("magnitude", "variation", Law.ABSOLUTE, _PAR, "s * (1 + k * (abs(v) - at))",
         (_k("1 / v"), _centre("v", GridScale.MEAN_ABSOLUTE_V)), 1, when=_OSCILLATES, order=1.0),
    EffectForm("square", "variation", Law.SQUARE, _PAR, "s * (1 + k * (v^2 - at))",
         (_k("1 / v^2"), _centre("v^2", GridScale.MEAN_SQUARE_V)), 1, order=1.0),
    EffectForm("saturating", "variation", Law.SATURATING, _PAR,
         "s * (1 - k * abs(v) / (half + abs(v)))",
         (_k("1"), _HALF), 1, when=(FormCondition.POSITIVE,), order=1.5),
    # Hill with exponent 2, for coils and ceramic capacitors: symmetric in the sign
    EffectForm("hill", "variation", Law.HILL, _PAR, "s * (1 - k * v^2 / (half^2 + v^2))",
         (_k("1"), _HALF), 1, order=1.5),
    EffectForm("hill_power", "variation", Law.HILL_POWER, _PAR,
         "s * (1 - k * max(v, 0)^n / (half^n + max(v, 0)^n))",
         (_k("1"), _HALF, _HILL), 1, when=(FormCondition.POSITIVE,), order=1.7, later=True),
    EffectForm("inverse", "variation", Law.INVERSE, _PAR, "s / (1 + k * (v - at))",
         (_k("1 / v"), _centre("v", GridScale.MEAN_V)), 1, order=1.2),
    EffectForm("inverse_square", "variation", Law.INVERSE_SQUARE, _PAR, "s / (1 + k * (v^2 - at))",
         (_k("1 / v^2"), _centre("v^2", GridScale.MEAN_SQUARE_V)), 1, order=1.2),
    EffectForm("power", "variation", Law.POWER, _PAR, "s * (max(abs(v), at / 1000) / at)^n",
         (FormCoefficient("n", unit="1"), _centre("v", GridScale.MEAN_ABSOLUTE_V)), 1,
         when=(FormCondition.POSITIVE,), order=1.2),
    # for a film by the flow past it (King, Nusselt), which still conducts without flow
    EffectForm("offset_power", "variation", Law.OFFSET_POWER, _PAR,
         "s * (1 + k * ((abs(v) / at)^n - 1))",
         (_k("1"), _shape("n", "1", GridScale.EXPONENT, 0.5, 1.5, 3.0),
          _centre("v", GridScale.MEAN_ABSOLUTE_V)), 1, order=1.4, later=True),
    EffectForm("exponential", "variation", Law.EXPONENTIAL, _PAR, "s * exp(k * (v - at))",
         (_k("1 / v"), _centre("v", GridScale.MEAN_V)), 1, order=1.2),
    # for a temperature: if the exponential law fits as well, this physical law is preferred
    EffectForm("arrhenius", "variation", Law.ARRHENIUS, _PAR,
         "s * exp(k * (1 / (at + zero) - 1 / (v + zero)))",
         (_k("v"), _centre("v", GridScale.MEAN_V), _ZERO), 1, order=1.1, later=True),
    EffectForm("lagged", "variation", Law.LAGGED, _PAR, "s * (1 + k * (z - at))",
         (_k("1 / v"), _centre("v", GridScale.MEAN_V), _tau(4.0, 15.0, 50.0)), 1, (_LAG,),
         order=1.1, later=True),
    EffectForm("delayed", "variation", Law.DELAYED, _PAR, f"s * (1 + k * ({_DELAYED} - at))",
         (_k("1 / v"), _centre("v", GridScale.MEAN_V), _tau(4.0, 15.0, 50.0)), 1, _DELAY_LINE,
         order=1.2, later=True),
    EffectForm("heating", "variation", Law.LAGGED_SQUARE, _PAR, "s * (1 + k * (z - at))",
         (_k("1 / v^2"), _centre("v^2", GridScale.MEAN_SQUARE_V), _tau(20.0, 80.0)), 1,
         (OwnState("z", "(v^2 - z) / tau", "0"),), order=1.0),
    *(
        EffectForm(name, FREE_FAMILY, Law.CURVE, _PAR, f"s * (1 + {_curve('v', _around(of), of)})",
             _curve_coefficients(_around(of), *_MOSTLY, unit="1"), 1, order=2.0, values=of,
             finer_than=coarse)
        for name, of, coarse in _resolutions("table")
    ),
)  # fmt: skip

_NOISES = (
    EffectForm("diffusion", NOISE_FAMILY, Law.OTHER, _DER, "0",
         (FormCoefficient("q", positive=True, unit="site second^0.5"),)),
    EffectForm("coloured_noise", NOISE_FAMILY, Law.OTHER, _DER, "z", _COLOURED, 0,
         (OwnState("z", "-z / tau", "0"),)),
    EffectForm("coloured_noise", NOISE_FAMILY, Law.OTHER, _IN, "s + z", _COLOURED, 0,
         (OwnState("z", "-z / tau", "0"),)),
)  # fmt: skip

PROCESS_NOISE: dict[tuple[SiteKind, str], EffectForm] = {
    (kind, f.name): f for f in _NOISES for kind in f.kinds
}
"""Forms of process noise: white noise q dW at the derivative, or at that of an own state z, which
is then an Ornstein-Uhlenbeck process. With such an effect, an extended Kalman filter replaces the
simulation. A search does not try these forms."""

FORMS: dict[tuple[SiteKind, str], EffectForm] = {
    (kind, f.name): f
    for f in (*_RATES, *STORES, *_SIGNALS, *_FORCES, *_TERMS, *_VARIATIONS)
    for kind in f.kinds
}
"""All forms, by kind of site and name."""


def form(kind: SiteKind, name: str, where: str) -> EffectForm:
    """Return the form with a given name for a kind of site.

    Raises
    ------
    EffectError
        If no form has that name for that kind of site.
    """
    if (kind, name) in PROCESS_NOISE:
        return PROCESS_NOISE[kind, name]
    if (kind, name) not in FORMS:
        known = [f for (k, _), f in (FORMS | PROCESS_NOISE).items() if k == kind]
        raise EffectError(
            f"{where}: there is no form {name!r} for a site of kind {kind}"
            f"{other_forms(name, known)}"
        )
    return FORMS[kind, name]


def other_forms(name: str, known: Iterable[EffectForm]) -> str:
    """Return the end of a message: the forms of the family with this name, or the nearest form."""
    family = dict.fromkeys(f.name for f in known if f.family == name.lower())
    if family:
        return f"; the forms of the family {name!r} are {', '.join(family)}"
    return nearest(name, dict.fromkeys(f.name for f in known))
