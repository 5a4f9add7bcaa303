"""The name of a found effect: its law, its place and the units of both, put together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy as sp

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.words.physics import PlacedLaw, physics_of
from cluster_est.closed_loop.findings.words.units import (
    ACCELERATION,
    AMOUNT,
    AREA,
    CONCENTRATION,
    DENSITY,
    FLOW,
    FORCE,
    LENGTH,
    MASS,
    MASS_FLOW,
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
from workers.effects.laws import Law
from workers.effects.site import EffectSite, bracketed, difference, is_difference, own_variable
from workers.fmu.description import ModelDescription

MOVING = (SPEED, TURNING, ACCELERATION, TURNING_FASTER, FORCE, TORQUE)


@dataclass(frozen=True)
class EffectName:
    """The name of an effect.

    Attributes
    ----------
    words
        "viscous friction", or "a term quadratic in v" where the units do not say what it is.
    placed
        What it was read from.
    physical
        It is one of physics.
    """

    words: str
    placed: PlacedLaw
    physical: bool

    def of_law(self, law: Law) -> str:
        """Return what physics calls another law at the same place; "" if nothing."""
        return physics_of(replace(self.placed, law=law))


class Namer:
    """Names effects of one model.

    Parameters
    ----------
    description, units
        Of the FMU, and what a config says of its units.
    """

    def __init__(self, description: ModelDescription, units: Mapping[str, str]) -> None:
        self.units = KnownUnits(description, units)
        self._level = _holds_levels(description, self.units)

    def name(
        self, candidate: EffectCandidate, values: Sequence[float], curve: EffectCurve | None
    ) -> EffectName:
        """Name an effect.

        Parameters
        ----------
        candidate, values
            The effect, and its coefficients.
        curve
            What it adds over its variable; None, or without points, where that is not known.
        """
        law, site = candidate.form.law, candidate.site
        variables = variables_of_effect(candidate)
        known: list[Dimension | None] = [self.units.of(name) for name in variables]
        targets = {self.units.of(target) for target in site.targets}
        seen = curve if curve is not None and len(curve.x) else None
        way = _way(candidate)
        change = _direction(candidate, law, values, seen) * (way or 1)
        placed = PlacedLaw(
            law=law,
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
        )
        physics = physics_of(placed).format(w=bracketed(variables[-1]) if variables else "")
        words = physics or _in_mathematics(law, site, variables)
        return EffectName(words, placed, bool(physics))

    def may_be_negative(self, variable: str) -> bool:
        """Return whether a variable can be below zero: an amount, for one, cannot."""
        known = self.units.of(variable)
        if known is None or is_difference(variable):
            return True
        if known == TEMPERATURE:  # an absolute one
            return False
        amounts = (MASS, AMOUNT, VOLUME, CONCENTRATION, DENSITY)
        return not known.same_as(*amounts, *((LENGTH,) if self._level else ()))


def _in_mathematics(law: Law, site: EffectSite, variables: tuple[str, ...]) -> str:
    """The law over the FMU's names of its variables, a difference as "(a - b)"."""
    first, *others = map(bracketed, variables or (site.target,))
    said = law.value.format(v=first, w=others[-1] if others else first, s=site.target)
    return said.replace("a term", "a variation", 1) if site.kind == "parameter" else said


def variables_of_effect(candidate: EffectCandidate) -> tuple[str, ...]:
    """Return the variables of an effect; at rates the state itself, or the pair's difference."""
    site = candidate.site
    if candidate.effect.variables or not candidate.form.variables:
        return candidate.effect.variables
    return (own_variable(site),) if site.at_rates else ()


def _holds_levels(description: ModelDescription, units: KnownUnits) -> bool:
    """Return whether a model has flows or areas, and nothing that moves."""
    variables = description.variables.values()
    known = [units.of(v.name) for v in variables if v.kind == "real" and v.unit]
    found = [d for d in known if d is not None]
    return any(d.same_as(FLOW, MASS_FLOW, AREA) for d in found) and not any(
        d.same_as(*MOVING) for d in found
    )


def _way(candidate: EffectCandidate) -> int:
    """How an input pushes the variable of an effect there: 1 or -1 where it is known, else 0.

    The bounds of a strength that takes energy out say it.
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
    over = difference(site.target, "")  # what is around it
    return site.kind == "derivative" and (
        variables[0] == site.target or variables[0].startswith(over)
    )


def _own_position(candidate: EffectCandidate, curve: EffectCurve | None) -> bool:
    """Return whether the variable is the integral of what is changed."""
    if curve is None or not curve.integral_of:
        return False
    if candidate.site.kind == "input":  # the search tried only what the input pushes
        return candidate.form.law is Law.PERIODIC
    return candidate.site.at_rates and curve.integral_of == own_variable(candidate.site)


def _direction(
    candidate: EffectCandidate, law: Law, values: Sequence[float], curve: EffectCurve | None
) -> int:
    """-1 where an effect is against its variable wherever that is not zero, 1 where along it.

    0 where it is neither. Over the range of the data, or around zero where no range is known. Of
    what begins at a threshold the distance from there counts.
    """
    if curve is None and law is Law.SWITCH_BY_MAGNITUDE:
        return -1  # its strength is bounded so that it takes energy out
    if curve is not None:
        x, y = curve.x, curve.y
        if candidate.site.kind == "parameter" and len(values):
            y = y - y[int(np.argmin(np.abs(x)))]
    else:
        x = np.array([-2.0, -1.0, 1.0, 2.0])
        found = _around_zero(candidate, values)
        y = np.array([found(each) for each in x]) if found is not None else np.zeros(len(x))
    of_sign = (Law.SWITCH_BY_MAGNITUDE, Law.SWITCH_BY_CURVE)  # their curves are for one direction
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
    """What an effect adds, over its variable, or over its one state where it has one."""
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
