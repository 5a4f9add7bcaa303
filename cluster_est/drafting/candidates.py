"""Parameters of an FMU that are likely to be estimated, and their bounds."""

from __future__ import annotations

import re
from dataclasses import dataclass

from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable

MOST_ACTIVE = 6
"""Parameters estimated at once in a first config: more are seldom determined by a few tables."""
MOST_LISTED = 60
WIDTH = 10.0
"""Guessed bounds are the start over and times this."""

_CONSTANTS = {"g", "pi", "e", "R_gas", "gravity", "c_light", "k_B", "sigma_SB", "T_ref", "p_ref"}
_SETTINGS = re.compile(
    r"(?i)(^|[._])(eps\w*|tol\w*|\w*_small|\w*_nominal|sample\w*|n_\w+|use_\w+|delay_buffer)$"
)
_SPECIFIC_HEAT = re.compile(r"k?J/(\(kg[.* ]?(K|degC)\)|kg/(K|degC)|kg[.](K|degC))")
_INITIAL = re.compile(r"(?i)(^|[._])(\w*_init(ial)?|\w*_start|x0|v0)$")
_KELVINS = 50.0
"""To both sides of a temperature: a tenth and ten times of it would be no temperatures."""


@dataclass(frozen=True)
class ParameterCandidate:
    """A parameter that could be estimated.

    Attributes
    ----------
    bounds
        Lower and upper; None where they are not known and cannot be guessed.
    origin
        The origin of the bounds, for a comment.
    why_not
        The reason why it is not estimated at first; "" if it is.
    per
        "experiment" if each is likely to have a value of its own; else "".
    """

    variable: ModelVariable
    start: float
    bounds: tuple[float, float] | None
    origin: str
    why_not: str = ""
    per: str = ""


def candidates(description: ModelDescription) -> list[ParameterCandidate]:
    """Return each real parameter with a start value, in the FMU's order; likely ones active."""
    found: list[ParameterCandidate] = []
    active = 0
    for variable in description.variables.values():
        if not _can_be_estimated(variable) or variable.start is None:
            continue
        bounds, origin = _bounds(variable, variable.start)
        same = next((c.variable.name for c in found if c.variable.name in variable.aliases), "")
        why_not = f"another name of {same}" if same else _why_not(variable, variable.start)
        if not why_not and active == MOST_ACTIVE:
            why_not = f"{MOST_ACTIVE} are enough to begin with; check says which ones matter"
        active += not why_not
        per = "experiment" if _INITIAL.search(variable.name) else ""
        found.append(ParameterCandidate(variable, variable.start, bounds, origin, why_not, per))
    return found


def initial_states(description: ModelDescription) -> list[ModelVariable]:
    """Return the states whose start can be set."""
    states = (description.variables[name] for name in description.states)
    return [v for v in states if v.settable and v.kind == "real"]


def _can_be_estimated(variable: ModelVariable) -> bool:
    own = variable.alias_of is None and variable.kind == "real" and not variable.is_tool_setting
    return own and variable.causality == "parameter" and variable.settable


def _why_not(variable: ModelVariable, start: float) -> str:
    """Return why a parameter is none of the likely ones; "" if it is one."""
    if variable.size > 1:
        return "one element of an array"
    if variable.name in _CONSTANTS:
        return "named like a constant of nature"
    if _INITIAL.search(variable.name):
        return "named like an initial value; estimate it where the experiments begin differently"
    if _SPECIFIC_HEAT.fullmatch(variable.unit):
        return "a specific heat, which is known of most substances"
    if _SETTINGS.search(variable.name):
        return "named like a setting, not like a property"
    if start == 0.0:
        return "its start is 0, which says nothing of its size; give a start and bounds"
    return ""


def _bounds(variable: ModelVariable, start: float) -> tuple[tuple[float, float] | None, str]:
    low, high = variable.low, variable.high
    inside = (low is None or low <= start) and (high is None or start <= high)
    if not inside:
        low = high = None
    guess, how = _guess(variable, start)
    if low is not None and high is not None and low < high:
        return (low, high), "bounds: the FMU's min and max"
    if start == 0.0:
        return None, "no bounds: nothing says how large it is"
    if low == 0.0 < start:
        return guess, f"bounds: a guess, {how}; the FMU's min is 0"  # a model may divide by it
    if low is not None:
        return (low, max(guess[1], low + abs(start))), "bounds: the FMU's min, and a guess"
    if high is not None:
        return (min(guess[0], high - abs(start)), high), "bounds: a guess, and the FMU's max"
    said = "" if inside else "; the FMU's own min and max exclude its start"
    return guess, f"bounds: a guess, {how}{said}"


def _guess(variable: ModelVariable, start: float) -> tuple[tuple[float, float], str]:
    if variable.unit in ("K", "degC"):
        ends, how = (start - _KELVINS, start + _KELVINS), f"{_KELVINS:g} K around the start"
    else:
        ends, how = (start / WIDTH, start * WIDTH), "a tenth and ten times the start"
    low, high = sorted(float(f"{end:.12g}") for end in ends)
    return (low, high), how
