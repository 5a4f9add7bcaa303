"""The variable of a form as text: a name of the FMU, or the difference of two, "a - b"."""

from __future__ import annotations

import re
from collections.abc import Container

from workers.effects.kinds import EffectForm
from workers.effects.site import EffectSite

_MINUS = " - "


def difference(first: str, second: str) -> str:
    """Return the text of the difference of two variables."""
    return f"{first}{_MINUS}{second}"


def is_difference(text: str) -> bool:
    """Return whether a text reads as a difference; the name of a variable may do so too."""
    return _MINUS in text


def parts_of(text: str) -> list[str]:
    """Return the two names of a text that reads as a difference, else the text."""
    return text.split(_MINUS)


def split_variable(text: str, known: Container[str]) -> tuple[str, ...]:
    """Return the name in a form's variable, the two of a difference "v - w", or none.

    Names of FMUs may hold almost any character, so only `known` ones tell what a minus is.
    """
    name = text.strip()
    if name in known:
        return (name,)
    for sign in re.finditer("-", name):
        pair = name[: sign.start()].strip(), name[sign.end() :].strip()
        if all(one in known for one in pair):
            return pair
    return ()


def bracketed(text: str) -> str:
    """Return a variable as it stands in an equation: a difference in brackets."""
    return f"({text})" if is_difference(text) else text


def own_variable(site: EffectSite) -> str:
    """Return the variable of a form at derivatives that names none: the state, or a difference."""
    return difference(*site.targets) if site.other else site.target


def unnamed_variables(form: EffectForm, site: EffectSite) -> tuple[str, ...]:
    """Return the variables that a form has where an effect names none."""
    return (own_variable(site),) if form.variables == 1 and site.at_rates else ()
