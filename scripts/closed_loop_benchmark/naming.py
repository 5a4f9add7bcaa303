"""Normal form of names of effects, and comparison of named effects with missing ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import permutations

from closed_loop_benchmark.effect import Name
from closed_loop_benchmark.scenarios import all_scenarios

BENCHMARK_NAMES = {
    "clip_above": "saturation",
    "signed_root": "leak",
    "periodic_travel": "cogging",
    "load_dependent_coulomb": "pressed_friction",
}
"""Forms of the library with other names in the benchmark; a gap at a single rate is another one."""


@dataclass(frozen=True)
class Match:
    """How well a true effect was named.

    Attributes
    ----------
    exact, alias
        By its canonical name; by that or by another name of the same model.
    form_and_site
        By its canonical name, whatever the variable.
    tied, plausible
        Whether a right name is indistinguishable from the named effect: within 2 units of the
        information criterion, or within 10.
    site, any_site
        Whether something was named at its site; at the site of any of its names.
    place
        Whether something was named at a site of its names, with the variable that it has there.
    """

    exact: bool
    alias: bool
    form_and_site: bool
    tied: bool
    plausible: bool
    site: bool
    any_site: bool
    place: bool


def normal(form: str, site: str, variables: Sequence[str] = ()) -> Name:
    """Return a name in normal form: variables sorted, and omitted if they are the site's own.

    Parameters
    ----------
    form, site, variables
        Of an effect of the library, or of the benchmark. A difference is "a-b" or "a - b".

    Returns
    -------
    Name
        Equal for the same effect.
    """
    place, _, targets = site.partition(" ")
    if place == "pair":
        site = f"pair {','.join(sorted(t.strip() for t in targets.split(',')))}"
    elif form == "gap" and site.startswith("der("):
        form = "end_stop"
    parts = [_difference(v) for variable in variables for v in variable.split("*") if v]
    own = site[4:-1] if site.startswith("der(") else targets
    if parts == [own]:
        parts = []
    return Name(BENCHMARK_NAMES.get(form, form), site, "*".join(sorted(parts)))


def compare(
    accepted: Iterable[Name], named: Sequence[Name], alternatives: Sequence[tuple[Name, float]]
) -> Match:
    """Compare a true effect with all named effects.

    Parameters
    ----------
    accepted
        Its canonical name, then its aliases.
    named
        Normal names of the added effects.
    alternatives
        Normal names of indistinguishable effects, and by how much they are worse.

    Returns
    -------
    Match
        The comparison.
    """
    right = [normal(n.form, n.site, (n.variable,)) for n in accepted]
    first, everything = right[0], set(right)
    tied = {*named, *(name for name, worse in alternatives if worse <= 2.0)}
    plausible = {*tied, *(name for name, worse in alternatives if worse <= 10.0)}
    return Match(
        exact=first in named,
        alias=bool(everything & set(named)),
        form_and_site=(first.form, first.site) in {(n.form, n.site) for n in named},
        tied=bool(everything & tied),
        plausible=bool(everything & plausible),
        site=first.site in {n.site for n in named},
        any_site=bool({n.site for n in right} & {n.site for n in named}),
        place=bool({(n.site, n.variable) for n in right} & {(n.site, n.variable) for n in named}),
    )


def _difference(variable: str) -> str:
    return "-".join(sorted(part.strip() for part in variable.split("-")))


def in_words(name: Name) -> str:
    """Return a name for a table."""
    return (
        f"{name.form}({name.variable}) at {name.site}"
        if name.variable
        else (f"{name.form} at {name.site}")
    )


def label_in_words(label: str) -> str:
    """Return the label of a candidate, "coulomb(w) at der(v)", as a name for a table."""
    called, _, site = label.partition(" at ")
    form, _, variables = called.removesuffix(")").partition("(")
    return in_words(normal(form, site, tuple(filter(None, variables.split(", ")))))


def is_true(named: Sequence[str], accepted: Sequence[Sequence[str]]) -> bool:
    """Return whether a set of effects is the true set, each with one of its accepted names."""
    if len(named) != len(accepted):
        return False
    return any(
        all(name in names for name, names in zip(order, accepted, strict=True))
        for order in permutations(named)
    )


@cache
def accepted_names() -> dict[str, list[list[str]]]:
    """Return, for each case, the names of each true effect, in words."""
    return {
        case.name: [
            [in_words(normal(n.form, n.site, (n.variable,))) for n in names]
            for names in case.accepted
        ]
        for case in all_scenarios()
    }
