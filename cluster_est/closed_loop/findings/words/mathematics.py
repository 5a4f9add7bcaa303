"""What mathematics calls an effect, where units do not say what physics would."""

from __future__ import annotations

from cluster_est.closed_loop.findings.words.laws import Law
from workers.effects.forms import EffectForm
from workers.effects.site import EffectSite, bracketed

OF_SIGNALS = {
    "bias": "an offset",
    "drift": "a drift in time",
    "gain": "another gain",
    "square": "a quadratic part",
    "cubic": "a cubic part",
    "power_characteristic": "a power law",
    "saturating": "a characteristic that levels off",
    "asymmetry": "another gain for positive values",
    "dead_zone": "a dead zone",
    "backlash": "backlash",
    "rate_limit": "a limit of the rate",
    "rate_limit_from_rest": "a limit of the rate, from zero on",
    "saturation": "saturation on both sides",
    "clip_above": "a limit from above",
    "clip_below": "a limit from below",
    "lag": "a lag of first order",
    "mode": "a lag of second order",
    "lag_from_rest": "a lag of first order that begins at zero",
    "mode_from_rest": "a lag of second order that begins at zero",
    "delay": "a delay",
    "absolute": "another gain for the magnitude",
    "characteristic": "a curved characteristic",
    "hum": "a sinusoid in time",
}
"""What signal processing calls a form at an input or an output, whatever is measured."""

TERMS = {
    Law.LINEAR: "a term linear in {v}",
    Law.ABSOLUTE: "a term proportional to the magnitude of {v}",
    Law.SQUARE: "a term quadratic in {v}",
    Law.ODD_SQUARE: "a term quadratic in {v} that has its sign",
    Law.CUBE: "a term cubic in {v}",
    Law.FOURTH: "a term of the fourth power of {v}",
    Law.INVERSE: "a term inverse in {v}",
    Law.INVERSE_SQUARE: "a term inverse in the square of {v}",
    Law.ABOVE_BY_POWER: "a power law in {v} above a threshold",
    Law.ROOT: "a term in the square root of {v}",
    Law.ODD_ROOT: "a term in the square root of {v} that has its sign",
    Law.POWER: "a power law in {v}",
    Law.EXPONENTIAL: "a term exponential in {v}",
    Law.SWITCH: "a term that switches with the sign of {v}",
    Law.SWITCH_WITH_PEAK: "a term that switches with the sign of {v}, with a peak near zero",
    Law.TWO_SWITCHES: "a term that switches with the sign of {v} between two levels",
    Law.SWITCH_BY_MAGNITUDE: (
        "a term that switches with the sign of {v}, proportional to the magnitude of {w}"
    ),
    Law.SWITCH_BY_CURVE: "a term that switches with the sign of {v}, by a free curve of {w}",
    Law.HYSTERESIS: "a hysteresis over {v}",
    Law.ABOVE: "a term linear in {v} above a threshold",
    Law.BELOW: "a term linear in {v} below a threshold",
    Law.GAP: "a term linear in {v} beyond a gap",
    Law.CLIPPED: "a term linear in {v} up to a limit",
    Law.SATURATING: "a term that saturates in {v}",
    Law.HILL: "a term that saturates in the square of {v}",
    Law.INHIBITED: "a term that falls at high {v}",
    Law.PERIODIC: "a term periodic in {v}",
    Law.PERIODIC_TRAVEL: "a term periodic in the integral of {v}",
    Law.LAGGED: "a term in the lagged {v}",
    Law.LAGGED_SQUARE: "a term in the lagged square of {v}",
    Law.CURVE: "a free curve of {v}",
    Law.CONSTANT: "a constant term",
    Law.DRIFT: "a drift in time",
    Law.WAVE: "a sinusoid in time",
    Law.OTHER: "a term in {v}",
}


def mathematics_of(law: Law, form: EffectForm, site: EffectSite, variables: tuple[str, ...]) -> str:
    """Return what mathematics calls an effect: "a term quadratic in v".

    Parameters
    ----------
    law
        Of the form.
    variables
        By the FMU's names; a difference stands as "a - b".
    """
    if not form.variables and site.kind in ("input", "output"):
        return OF_SIGNALS.get(form.name, "another characteristic")
    named = [bracketed(v) for v in variables]
    if law is Law.FOURTH_DIFFERENCE:
        return f"a term in the difference of the fourth powers of {' and '.join(named)}"
    if law is Law.PRODUCT:
        factors = named if form.variables == 2 else [site.target, *named]
        return f"a product of {' and '.join(factors)}"
    first, last = (named[0], named[-1]) if named else (site.target, site.target)
    said = TERMS.get(law, "a term in {v}").format(v=first, w=last)
    if site.kind == "parameter":
        return said.replace("a term", "a variation", 1)
    return said
