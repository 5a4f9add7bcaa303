"""Undeclared effects: their names, sites and numbers (`effects.toml`)."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from closed_loop_benchmark.system import System

WEAKER_WHEN_LARGER = {"saturation": -0.15, "rate_limit": -0.3}
"""Forms whose first number is a limit, with the power of the size by which it is multiplied."""


class Name(NamedTuple):
    """The correct answer of a method.

    Attributes
    ----------
    form
        "coulomb", "dead_zone" and so on.
    site
        "der(STATE)", "input INPUT", "output OUTPUT", "parameter NAME" or "pair STATE,STATE".
    variable
        Argument of the form, if it is not the site itself. "a-b" is a difference.
    """

    form: str
    site: str
    variable: str = ""


@dataclass(frozen=True)
class Effect:
    """One effect that the FMU lacks.

    Attributes
    ----------
    label
        Short name, unique in a system.
    form, site, variable
        See `Name`.
    numbers
        Numbers of the form; the first is its strength.
    second
        The other variable of a product.
    weights
        For a pair: factors of the form in the two rates.
    also
        Other names of the same model, in addition to those of `names`.
    constants
        Its coefficients in the library's form, by name, if given in this way.
    """

    label: str
    form: str
    site: str
    numbers: tuple[float, ...]
    variable: str = ""
    second: str = ""
    weights: tuple[float, ...] = (1.0,)
    also: tuple[Name, ...] = field(default=(), repr=False)
    constants: tuple[tuple[str, float], ...] = field(default=(), repr=False)

    @property
    def kind(self) -> str:
        """One of "der", "pair", "input", "output" and "parameter"."""
        return "der" if self.site.startswith("der(") else self.site.split()[0]

    @property
    def targets(self) -> tuple[str, ...]:
        """The states, or the input, output or parameter, on which the effect acts."""
        inner = self.site[4:-1] if self.kind == "der" else self.site.split()[1]
        return tuple(inner.split(","))

    def scaled(self, size: float) -> Effect:
        """Return the effect multiplied by `size`."""
        power = WEAKER_WHEN_LARGER.get(self.form, 1.0)
        first, *others = self.numbers
        return replace(self, numbers=(first * size**power, *others))


PLAIN_FORMS = {
    "bias": "constant",
    "drift": "drift",
    "linear": "linear",
    "coulomb": "coulomb",
    "quadratic": "quadratic",
    "cubic": "cubic",
    "end_stop": "end_stop",
    "hinge": "hinge",
    "sine": "sine",
}
"""Forms at an input, and their names at the only rate that the input drives."""

OWN_FORMS = {
    "gain": "linear",
    "square": "square",
    "cubic": "cubic",
    "asymmetry": "hinge",
    "saturation": "end_stop",
}
"""Forms of an input's own value, and their names at the only rate that the input drives."""

SYNONYMS = [{"viscous", "linear"}, {"end_stop", "gap"}, {"gap", "joint"}]
"""Forms at one site that are the same function, or the same after a refit of a stiffness."""


def names(effect: Effect, system: System) -> tuple[Name, ...]:
    """Return the canonical name of an effect and its algebraic aliases.

    The aliases follow from the equations alone. Candidates that are indistinguishable on the data
    must be found numerically.

    Parameters
    ----------
    effect
        The effect.
    system
        The system that lacks it.

    Returns
    -------
    tuple of Name
        The canonical name first.
    """
    variable = f"{effect.variable}*{effect.second}" if effect.second else effect.variable
    canonical = Name(effect.form, effect.site, variable)
    found = [canonical, *effect.also]
    found += [alias for name in list(found) for alias in _across_input(name, system)]
    found += [alias for name in list(found) for alias in _synonyms(name)]
    return tuple(dict.fromkeys(found))


def _across_input(name: Name, system: System) -> Iterable[Name]:
    for given, state in system.drives:
        source, rate = f"input {given}", f"der({state})"
        if name.site == source and name.form in OWN_FORMS:
            yield Name(OWN_FORMS[name.form], rate, given)
        if name.site == source and name.form in PLAIN_FORMS:
            yield Name(PLAIN_FORMS[name.form], rate, name.variable)
        if name.site == source and name.form == "product":
            yield Name("product", rate, f"{name.variable}*{given}")
        for at_input, at_rate in PLAIN_FORMS.items():
            if name.site == rate and name.form == at_rate and name.variable != given:
                yield Name(at_input, source, name.variable)


def _synonyms(name: Name) -> Iterable[Name]:
    for group in SYNONYMS:
        if name.form in group:
            yield from (name._replace(form=form) for form in sorted(group - {name.form}))


FILE = tomllib.loads(Path(__file__).with_name("effects.toml").read_text(encoding="utf-8"))


def _read(section: str) -> dict[str, tuple[Effect, ...]]:
    """Read the effects of a section of the file, by system."""
    return {
        system: tuple(_effect(system, label, given) for label, given in own.items())
        for system, own in FILE[section].items()
    }


def _effect(system: str, label: str, given: list[Any]) -> Effect:
    form, site, numbers, *variables = given
    variable, second = [*variables, "", ""][:2]
    also = tuple(Name(*name) for name in FILE["also"].get(system, {}).get(label, ()))
    weights: tuple[float, ...] = (1.0,)
    if site.startswith("pair "):
        one, other = FILE["inertias"][system]
        weights = (1.0 / one, -1.0 / other)
    return Effect(label, form, site, tuple(numbers), variable, second, weights, also)


SINGLE = _read("single")
"""Effects of forms that a library should have, by system."""

OUTSIDE = _read("outside")
"""Effects of forms that no library has, by system."""

TEXTBOOK = _read("textbook")
"""Effects from textbooks of physics, in a library or not, by system."""

PAIRS: dict[str, list[list[str]]] = FILE["pairs"]
TRIPLES: dict[str, list[list[str]]] = FILE["triples"]
"""Labels of two and of three simultaneous effects, by system."""
