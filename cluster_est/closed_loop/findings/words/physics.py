"""What physics calls a law at a place, where the units of both leave no doubt; else nothing.

A wrong name costs more than none, so each rule asks for all that makes it true: which rate is
changed, by what, in which direction, and whether the variable is the one whose rate it is.
"""

from __future__ import annotations

from dataclasses import dataclass

from cluster_est.closed_loop.findings.words.units import (
    AMOUNT,
    ANGLE,
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
    VOLUME,
    Dimension,
)
from workers.effects.kinds import SiteKind
from workers.effects.laws import Law


@dataclass(frozen=True)
class PlacedLaw:
    """A law where it acts.

    Attributes
    ----------
    law, kind
        The law, and the kind of its site.
    site
        Dimension of the state whose rate it changes, or of the signal.
    argument, second
        Dimensions of its variables; None where there is none or its unit is unknown.
    own
        Its variable is what it changes: the state of the rate, the difference of the pair, or a
        state that the input is known to push, and in which direction.
    own_position
        Its variable is the integral of what it changes.
    loss, gain
        It takes from what it changes where its variable is positive, or beyond a threshold, and
        gives where that is negative; or the other way round.
    one_sided
        Its variable kept one sign in the data.
    level
        A length is the level of a fluid: the model has flows or areas, and nothing that moves.
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

    @property
    def at_rates(self) -> bool:
        return self.kind in ("derivative", "pair")


def physics_of(placed: PlacedLaw) -> str:
    """Return what physics calls a law at its place; "" where the units do not say."""
    if placed.site is None or placed.kind == "output":
        return ""
    rules = (_load, _motion, _heat, _flow, _stock, _kinetics, _circuit)
    return next((word for rule in rules if (word := rule(placed))), "")


def _load(placed: PlacedLaw) -> str:
    """A force that is always there."""
    always = placed.law in (Law.CONSTANT, Law.OFFSET)
    return "constant load" if always and _pushes(placed) is not None else ""


def _pushes(placed: PlacedLaw) -> Dimension | None:
    """The speed that is changed by what a law adds; None where it is no speed."""
    assert placed.site is not None
    if placed.at_rates:
        return next((d for d in (SPEED, TURNING) if placed.site.same_as(d)), None)
    if placed.kind == "input" and placed.site.same_as(FORCE):
        return SPEED
    return TURNING if placed.kind == "input" and placed.site.same_as(TORQUE) else None


FRICTION = {
    Law.LINEAR: "viscous friction",
    Law.ODD_SQUARE: "drag",
    Law.CUBE: "damping that grows with the cube of the speed",
    Law.POWER: "drag that goes with a power of the speed",
    Law.SWITCH: "Coulomb friction",
    Law.SWITCH_WITH_PEAK: "Stribeck friction",
    Law.TWO_SWITCHES: "Coulomb friction, unlike in the two directions",
    Law.SWITCH_BY_MAGNITUDE: "Coulomb friction proportional to the magnitude of {w}",
    Law.SWITCH_BY_CURVE: "Coulomb friction that depends on {w}",
    Law.HYSTERESIS: "friction with presliding (Dahl)",
}
"""Of a body against its surroundings, or of two against each other."""
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
    return "cogging or eccentricity" if way is ANGLE else "ripple along the way"


def _heat(placed: PlacedLaw) -> str:
    assert placed.site is not None
    if not placed.site.same_as(TEMPERATURE) or not placed.at_rates or placed.argument is None:
        return ""
    if placed.argument.same_as(TEMPERATURE) and placed.own and placed.loss:
        goes = "heat conduction or convection" if placed.kind == "pair" else "heat loss"
        if placed.law is Law.POWER:
            return f"{goes} by a power law (as of natural convection)"
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
        return "convection (heat that a flow carries)" if carried and warm else ""
    return ""


def _stocks(placed: PlacedLaw) -> tuple[Dimension, ...]:
    """What drives a fluid, or holds it."""
    return (PRESSURE, VOLUME, LENGTH) if placed.level else (PRESSURE, VOLUME)


def _flow(placed: PlacedLaw) -> str:
    """A fluid that leaves, or goes from one place to another."""
    assert placed.site is not None
    stocks = _stocks(placed)
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
        return "outflow by a power law (as through an orifice or over a weir)"
    if placed.law is not Law.ABOVE:
        return ""
    relieved = placed.argument.same_as(PRESSURE)
    return "outflow above a threshold (as of a relief valve)" if relieved else "overflow"


def _stock(placed: PlacedLaw) -> str:
    """A loss of what else can be stored."""
    assert placed.site is not None
    if not placed.loss or not placed.own or not placed.at_rates:
        return ""
    if placed.law in (Law.SQUARE, Law.ODD_SQUARE) and placed.kind == "derivative":
        reacts = placed.site.same_as(CONCENTRATION) and placed.one_sided
        return "second-order loss (as of a reaction)" if reacts else ""
    if placed.law is not Law.LINEAR:
        return ""
    if placed.site.same_as(CHARGE):
        return "leakage of charge"
    if placed.site.same_as(MASS, AMOUNT, CONCENTRATION, DENSITY):
        pair = placed.kind == "pair"
        return "exchange between the two" if pair else "first-order loss (leakage or decay)"
    return ""


def _kinetics(placed: PlacedLaw) -> str:
    """Rates that an amount limits."""
    known = placed.argument
    if known is None:
        return ""
    if placed.law is Law.EXPONENTIAL and placed.kind == "parameter" and known == TEMPERATURE:
        return "an exponential rise with temperature (as of Arrhenius)" if placed.gain else ""
    if not known.same_as(AMOUNT, CONCENTRATION, DENSITY, MASS):
        return ""
    if placed.law in (Law.SATURATING, Law.HILL, Law.INVERSE) and placed.kind == "parameter":
        return "inhibition" if placed.loss else ""
    return "saturation (as of Michaelis and Menten)" if placed.law is Law.SATURATING else ""


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
