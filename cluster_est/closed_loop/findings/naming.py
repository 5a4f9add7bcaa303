"""The name of an effect that was found: from physics if possible, otherwise from mathematics.

An effect gets a name from physics only if the units of law and site leave no doubt. A wrong name is
worse than none, so each rule checks everything that the name implies: which rate is changed, by
which variable, in which direction, and whether this variable is the one whose rate is changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy as sp

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.effect_curves import (
    ONE_THRESHOLD,
    law_of_one_side,
    missed_thresholds,
)
from cluster_est.problem.dimensions import (
    ACCELERATION,
    AMOUNT,
    ANGLE,
    AREA,
    CHARGE,
    CONCENTRATION,
    CURRENT,
    DENSITY,
    FLOW,
    FORCE,
    HEAT_FLUX,
    LENGTH,
    MASS,
    MASS_FLOW,
    POWER,
    PRESSURE,
    SPEED,
    TEMPERATURE,
    TORQUE,
    TURNING,
    TURNING_FASTER,
    VOLUME,
    Dimension,
    KnownUnits,
)
from cluster_est.results.fit_tables import EffectCurve
from workers.effects.expression import parse
from workers.effects.kinds import SiteKind
from workers.effects.laws import Law
from workers.effects.site import EffectSite, bracketed, difference, is_difference, own_variable
from workers.fmu.description import ModelDescription

OF_DRAG = (1.0, 2.0)
"""Exponents of the drag in a fluid: laminar (Stokes) and turbulent flow (Newton)."""
OF_NATURAL_CONVECTION = (5.0 / 4.0, 4.0 / 3.0)
"""Exponents of the difference of temperatures: laminar and turbulent natural convection."""
OF_ORIFICE, OF_WEIRS = 0.5, (1.5, 2.5)
"""Exponents of a pressure or level at an orifice, and of a level above a weir that is rectangular
or triangular."""
MOVING = (SPEED, TURNING, ACCELERATION, TURNING_FASTER, FORCE, TORQUE)


@dataclass(frozen=True)
class EffectName:
    """The name of an effect, and the facts from which it was derived.

    For example "viscous friction", or "a term quadratic in v" if the units do not determine a name.
    """

    words: str
    placed: PlacedLaw

    def of_law(self, law: Law) -> str:
        """Return the name in physics of another law at the same site; "" if there is none."""
        return physics_of(replace(self.placed, law=law))


class Namer:
    """Names the effects of one model, from the units in its FMU and in the config."""

    def __init__(self, description: ModelDescription, units: Mapping[str, str]) -> None:
        self.units = KnownUnits(description, units)
        self._level = _holds_levels(description, self.units)

    def name(
        self,
        candidate: EffectCandidate,
        values: Sequence[float],
        curve: EffectCurve | None,
        exponent: tuple[float, float] | None = None,
    ) -> EffectName:
        """Name an effect, from its coefficients, its curve, and its exponent's interval, if known.

        Without an interval, the value of the exponent is used.
        """
        law, site = candidate.form.law, candidate.site
        variables = variables_of_effect(candidate)
        known: list[Dimension | None] = [self.units.of(name) for name in variables]
        targets = {self.units.of(target) for target in site.targets}
        drawn = curve is not None and len(curve.x) > 0 and not candidate.form.is_dynamics
        seen = curve if drawn else None
        missed = missed_thresholds(law, _known(candidate, values), seen)
        way = _way(candidate)
        change = _direction(candidate, law, values, seen) * (way or 1)
        placed = PlacedLaw(
            law=law_of_one_side(law, missed),
            kind=site.kind,
            site=targets.pop() if len(targets) == 1 else None,
            argument=known[0] if known else None,
            second=known[1] if len(known) > 1 else None,
            own=_own(candidate, law, variables, way),
            own_position=_own_position(candidate, seen),
            loss=change < 0,
            gain=change > 0,
            one_sided=seen is not None and (seen.x.min() >= 0.0 or seen.x.max() <= 0.0),
            level=self._level,
            of_difference=bool(variables) and is_difference(variables[0]),
            exponent=exponent or _exponent(candidate, values),
        )
        if law in ONE_WAVE and _at_lowest(candidate, values):
            (said,) = map(ONE_WAVE[law].format, map(bracketed, variables or (site.target,)))
            return EffectName(said, replace(placed, law=Law.OTHER))
        if missed and law in ONE_THRESHOLD:
            said = f"{_in_mathematics(law, site, variables)} that the data do not pass"
            return EffectName(said, replace(placed, law=Law.OTHER))
        physics = physics_of(placed).format(w=bracketed(variables[-1]) if variables else "")
        words = physics or _in_mathematics(placed.law, site, variables)
        return EffectName(words, placed)


ONE_WAVE = {
    Law.PERIODIC: "a term in {} that shows only one period in the data",
    Law.PERIODIC_TRAVEL: "a term in the integral of {} that shows only one period in the data",
    Law.PERIODIC_ERROR: "a part that varies over {} and shows only one period in the data",
}
"""Names of waves with the longest allowed period: the data do not show that they repeat."""


def _known(candidate: EffectCandidate, values: Sequence[float]) -> dict[str, float]:
    """Return the coefficients by name; empty if they are unknown."""
    names = [c.name for c in candidate.form.coefficients]
    return dict(zip(names, values, strict=True)) if len(names) == len(values) else {}


def _exponent(candidate: EffectCandidate, values: Sequence[float]) -> tuple[float, float] | None:
    """Return the exponent n of a power law, as an interval of no width; None if it is unknown."""
    n = _known(candidate, values).get("n", np.nan)
    return (n, n) if np.isfinite(n) else None


def _at_lowest(candidate: EffectCandidate, values: Sequence[float]) -> bool:
    """Return whether a wave has the longest period that the search allows."""
    numbers = {c.name: i for i, c in enumerate(candidate.form.coefficients)}
    i = numbers.get("n", len(values))
    return i < len(values) and values[i] <= (1.0 + AT_LOWEST) * candidate.lowest[i]


AT_LOWEST = 1e-6
"""Relative distance within which a coefficient is at its bound, to allow for rounding."""


def _in_mathematics(law: Law, site: EffectSite, variables: tuple[str, ...]) -> str:
    """Name the law in mathematics, with the FMU's names of the variables."""
    first, *others = map(bracketed, variables or (site.target,))
    said = law.value.format(v=first, w=others[-1] if others else first, s=site.target)
    return said.replace("a term", "a variation", 1) if site.kind == "parameter" else said


def variables_of_effect(candidate: EffectCandidate) -> tuple[str, ...]:
    """Return the variables of an effect; by default the state itself, or a pair's difference."""
    site = candidate.site
    if candidate.effect.variables or not candidate.form.variables:
        return candidate.effect.variables
    return (own_variable(site),) if site.at_rates else ()


def _holds_levels(description: ModelDescription, units: KnownUnits) -> bool:
    """Return whether a model has flows or areas, and no moving parts."""
    variables = description.variables.values()
    known = [units.of(v.name) for v in variables if v.kind == "real" and v.unit]
    found = [d for d in known if d is not None]
    return any(d.same_as(FLOW, MASS_FLOW, AREA) for d in found) and not any(
        d.same_as(*MOVING) for d in found
    )


def _way(candidate: EffectCandidate) -> int:
    """Return in which direction an input pushes the variable: 1 or -1, or 0 if not known.

    It follows from the bounds of a strength that removes energy.
    """
    if candidate.site.kind != "input":
        return 0
    ends = {
        (candidate.lowest[i] >= 0.0, candidate.highest[i] <= 0.0)
        for i, c in enumerate(candidate.form.coefficients)
        if c.positive and c.name in candidate.strengths
    }
    return {(True, False): 1, (False, True): -1}.get(next(iter(ends)), 0) if len(ends) == 1 else 0


def _own(candidate: EffectCandidate, law: Law, variables: tuple[str, ...], way: int) -> bool:
    site = candidate.site
    if site.kind == "input":
        return way != 0
    if not variables:
        return False
    if site.kind == "pair":
        spill = law is Law.ABOVE and variables[0] == site.target
        return spill or variables[0] == own_variable(site)
    over = difference(site.target, "")  # differences between the state and its surroundings
    factors = variables if law is Law.PRODUCT else variables[:1]
    return site.kind == "derivative" and any(
        v == site.target or v.startswith(over) for v in factors
    )


def _own_position(candidate: EffectCandidate, curve: EffectCurve | None) -> bool:
    """Return whether the variable is the integral of the quantity that the effect changes."""
    if curve is None or not curve.integral_of:
        return False
    if candidate.site.kind == "input":  # the search tried only states that the input acts on
        return candidate.form.law is Law.PERIODIC
    return candidate.site.at_rates and curve.integral_of == own_variable(candidate.site)


def _direction(
    candidate: EffectCandidate, law: Law, values: Sequence[float], curve: EffectCurve | None
) -> int:
    """Return -1 if an effect always acts against its variable, 1 if always along it, else 0.

    The range of the data is used, or values around zero if no range is known. For an effect with a
    threshold, the distance from the threshold is used instead of the variable.
    """
    if curve is None and law is Law.SWITCH_BY_MAGNITUDE:
        return -1  # the bounds of its strength make it remove energy
    if law is Law.PRODUCT:
        return int(np.sign(values[0])) if len(values) and np.isfinite(values[0]) else 0
    if curve is not None:
        x, y = curve.x, curve.y
        if candidate.site.kind == "parameter" and len(values):
            y = y - y[int(np.argmin(np.abs(x)))]
    else:
        x = np.array([-2.0, -1.0, 1.0, 2.0])
        found = _around_zero(candidate, values)
        y = np.array([found(each) for each in x]) if found is not None else np.zeros(len(x))
    of_sign = (Law.SWITCH_BY_MAGNITUDE, Law.SWITCH_BY_CURVE)  # their curves hold for one direction
    work = {Law.ABOVE: y, Law.BELOW: -y, **dict.fromkeys(of_sign, y)}.get(law, x * y)
    if not np.isfinite(work).all() or not work.any():
        return 0
    least = 1e-9 * float(np.abs(work).max())
    if (work <= least).all():
        return -1
    return 1 if (work >= -least).all() else 0


def _around_zero(
    candidate: EffectCandidate, values: Sequence[float]
) -> Callable[[float], float] | None:
    """Return an effect as a function of its variable or only internal state; None if unknown."""
    form = candidate.form
    if form.memory or form.free or form.variables != 1 or len(values) != len(form.coefficients):
        return None
    over = form.states[0].name if form.states else "v"
    names = ["t", "s", "w", "v", *(z.name for z in form.states)]
    symbols = {n: sp.Symbol(n, real=True) for n in [*names, *(c.name for c in form.coefficients)]}
    term = parse(form.equation, symbols, f"form {form.name}")
    if candidate.site.kind in ("input", "output"):
        term = sp.expand(term - symbols["s"])
    arguments = [symbols[over], *(symbols[c.name] for c in form.coefficients)]
    if term.free_symbols - set(arguments):
        return None
    compiled = sp.lambdify(arguments, term, "numpy")

    def added(x: float) -> float:
        with np.errstate(all="ignore"):
            return float(compiled(np.float64(x), *map(np.float64, values)))

    return added


@dataclass(frozen=True)
class PlacedLaw:
    """A law at a site.

    Attributes
    ----------
    kind, site
        Kind of the site; dimension of the signal there, or of the state whose rate is changed.
    argument, second
        Dimensions of the variables; None if there is no such variable or its unit is unknown.
    own
        Whether the variable is the quantity that the effect changes: the state of the rate, the
        difference of the pair, or a state that the input is known to push in a known direction.
    own_position
        Whether the variable is the integral of this quantity.
    loss
        The effect decreases the quantity if the variable is positive, or beyond a threshold, and
        increases it if the variable is negative. For a product: its coefficient is negative.
    gain
        The opposite of `loss`. Both may be false.
    one_sided
        Whether the variable had the same sign in all data.
    level
        Whether a length is the level of a fluid: the model has flows or areas, and no moving parts.
    of_difference
        Whether the first variable is a difference of two variables.
    exponent
        Interval of the exponent of a power law; None if it is unknown.
    """

    law: Law
    kind: SiteKind
    site: Dimension | None
    argument: Dimension | None = None
    second: Dimension | None = None
    own: bool = False
    own_position: bool = False
    loss: bool = False
    gain: bool = False
    one_sided: bool = False
    level: bool = False
    of_difference: bool = False
    exponent: tuple[float, float] | None = None

    def has_exponent(self, low: float, high: float) -> bool:
        """Return whether the interval of the exponent meets what is known from physics."""
        return self.exponent is not None and self.exponent[0] <= high and low <= self.exponent[1]

    @property
    def at_rates(self) -> bool:
        return self.kind in ("derivative", "pair")

    @property
    def feeds_energy(self) -> bool:
        """Whether the effect pushes a body in its direction of motion."""
        speed = _pushes(self) if self.site is not None and self.argument is not None else None
        along = speed is not None and self.argument is not None and self.argument.same_as(speed)
        return along and self.own and self.gain


def physics_of(placed: PlacedLaw) -> str:
    """Return the name in physics of a law at a site; "" if the units do not determine one."""
    if placed.site is None or placed.kind == "output":
        return ""
    if placed.law in (Law.CONSTANT, Law.OFFSET):
        return "constant load" if _pushes(placed) is not None else ""
    rules = (_motion, _heat, _flow, _stock, _kinetics, _circuit)
    return next((word for rule in rules if (word := rule(placed))), "")


def _pushes(placed: PlacedLaw) -> Dimension | None:
    """Return the dimension of the speed that a law changes; None if it changes no speed."""
    assert placed.site is not None
    if placed.at_rates:
        return next((d for d in (SPEED, TURNING) if placed.site.same_as(d)), None)
    if placed.kind == "input" and placed.site.same_as(FORCE):
        return SPEED
    return TURNING if placed.kind == "input" and placed.site.same_as(TORQUE) else None


FRICTION = {
    Law.LINEAR: "viscous friction",
    Law.ODD_SQUARE: "quadratic drag",
    Law.CUBE: "damping that grows with the cube of the speed",
    Law.POWER: "friction proportional to a power of the speed",
    Law.SWITCH: "Coulomb friction",
    Law.SWITCH_WITH_PEAK: "Stribeck friction",
    Law.TWO_SWITCHES: "Coulomb friction that differs between the two directions",
    Law.SWITCH_BY_MAGNITUDE: "Coulomb friction proportional to the magnitude of {w}",
    Law.SWITCH_BY_CURVE: "Coulomb friction that depends on {w}",
    Law.HYSTERESIS: "presliding friction (Dahl model)",
}
"""Names for friction of a body against its surroundings, or between two bodies."""
SPRING = {
    Law.LINEAR: "stiffness (a spring)",
    Law.CUBE: "stiffness that grows with the deflection",
    Law.ABOVE: "end stop",
    Law.BELOW: "end stop",
    Law.GAP: "end stops on both sides (play between them)",
    Law.CLIPPED: "spring that yields",
}


def _motion(placed: PlacedLaw) -> str:
    speed = _pushes(placed)
    if speed is None or placed.argument is None:
        return ""
    way = LENGTH if speed is SPEED else ANGLE
    if placed.own and placed.loss and placed.argument.same_as(speed):
        if placed.law is Law.POWER and placed.has_exponent(*OF_DRAG):
            return "drag proportional to a power of the speed"
        squared = placed.law is Law.SQUARE and placed.one_sided
        return FRICTION.get(Law.ODD_SQUARE if squared else placed.law, "")
    if placed.law is Law.PERIODIC_TRAVEL and placed.own and placed.argument.same_as(speed):
        return _ripple(way)
    if not placed.own_position or not placed.argument.same_as(way):
        return ""
    if placed.law is Law.PERIODIC:
        return _ripple(way)
    return SPRING.get(placed.law, "") if placed.loss else ""


def _ripple(way: Dimension) -> str:
    return "cogging or eccentricity" if way is ANGLE else "ripple along the travel"


def _heat(placed: PlacedLaw) -> str:
    assert placed.site is not None
    if not placed.site.same_as(TEMPERATURE) or not placed.at_rates or placed.argument is None:
        return ""
    if placed.argument.same_as(TEMPERATURE) and placed.own and placed.loss:
        goes = "heat conduction or convection" if placed.kind == "pair" else "heat loss"
        if placed.law is Law.POWER:
            natural = placed.of_difference and placed.has_exponent(*OF_NATURAL_CONVECTION)
            return f"{goes} by a power law{' (as in natural convection)' if natural else ''}"
        return goes if placed.law is Law.LINEAR else ""
    if placed.law is Law.FOURTH_DIFFERENCE:
        return "thermal radiation"
    if placed.law is Law.SQUARE and placed.gain and placed.argument.same_as(CURRENT):
        return "Joule heating"
    if placed.law is Law.LINEAR and placed.gain and placed.argument.same_as(POWER, HEAT_FLUX):
        return "heating"
    if placed.law is Law.PRODUCT and placed.second is not None:
        pair = (placed.argument, placed.second)
        carried = any(d.same_as(FLOW, MASS_FLOW, SPEED) for d in pair)
        warm = any(d.same_as(TEMPERATURE) for d in pair)
        # a flow takes the heat of the state away, and brings that of another place
        right_way = placed.loss if placed.own else placed.gain
        return "convection (heat transport by a flow)" if carried and warm and right_way else ""
    return ""


def _flow(placed: PlacedLaw) -> str:
    """Name the flow of a fluid out of a store, or from one store to another."""
    assert placed.site is not None
    stocks = (PRESSURE, VOLUME, LENGTH) if placed.level else (PRESSURE, VOLUME)
    if placed.argument is None or not placed.loss or not placed.argument.same_as(*stocks):
        return ""
    drained = placed.at_rates and placed.own and placed.site.same_as(*stocks)
    fed = placed.kind == "input" and placed.own and placed.site.same_as(FLOW, MASS_FLOW)
    if not drained and not fed:
        return ""
    if placed.law is Law.LINEAR:
        return "leakage"
    if placed.law in (Law.ROOT, Law.ODD_ROOT):
        return "flow through an orifice"
    if placed.law is Law.POWER:
        return f"outflow by a power law{_outflow(placed)}"
    if placed.law is not Law.ABOVE:
        return ""
    relieved = placed.argument.same_as(PRESSURE)
    return "outflow above a threshold (as through a relief valve)" if relieved else "overflow"


def _outflow(placed: PlacedLaw) -> str:
    """Name the openings that have such an exponent; "" if there are none."""
    level = placed.argument is not None and placed.argument.same_as(LENGTH)
    known = ["through an orifice"] if placed.has_exponent(OF_ORIFICE, OF_ORIFICE) else []
    known += ["over a weir"] if level and any(placed.has_exponent(n, n) for n in OF_WEIRS) else []
    return f" (as {' or '.join(known)})" if known else ""


def _stock(placed: PlacedLaw) -> str:
    """Name the loss of another quantity that can be stored."""
    assert placed.site is not None
    if not placed.loss or not placed.own or not placed.at_rates:
        return ""
    if placed.law in (Law.SQUARE, Law.ODD_SQUARE) and placed.kind == "derivative":
        reacts = placed.site.same_as(CONCENTRATION) and placed.one_sided
        return "second-order loss (as in a reaction)" if reacts else ""
    if placed.law is not Law.LINEAR:
        return ""
    if placed.site.same_as(CHARGE):
        return "charge leakage"
    if placed.site.same_as(MASS, AMOUNT, CONCENTRATION, DENSITY):
        pair = placed.kind == "pair"
        return "exchange between the two" if pair else "first-order loss (leakage or decay)"
    return ""


def _kinetics(placed: PlacedLaw) -> str:
    """Name a reaction rate that an amount limits."""
    known = placed.argument
    if known is None:
        return ""
    if placed.law is Law.EXPONENTIAL and placed.kind == "parameter" and known == TEMPERATURE:
        return "an exponential rise with temperature (Arrhenius law)" if placed.gain else ""
    if not known.same_as(AMOUNT, CONCENTRATION, DENSITY, MASS):
        return ""
    inhibits = (Law.SATURATING, Law.HILL, Law.HILL_POWER, Law.INVERSE)
    if placed.law in inhibits and placed.kind == "parameter":
        return "inhibition" if placed.loss else ""
    return "saturation (Michaelis-Menten kinetics)" if placed.law is Law.SATURATING else ""


def _circuit(placed: PlacedLaw) -> str:
    assert placed.site is not None
    known = placed.argument
    if known is None:
        return ""
    if placed.kind == "parameter" and placed.law is Law.LAGGED_SQUARE and known.same_as(CURRENT):
        return "self-heating by the current"
    if not placed.at_rates or not placed.site.same_as(CURRENT):
        return ""
    if placed.law is not Law.LINEAR or not placed.loss:
        return ""
    if placed.own:
        return "electrical resistance"
    return "induced voltage (back-EMF)" if known.same_as(SPEED, TURNING) else ""
