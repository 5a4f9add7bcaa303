"""Sites of effects: where in the model an effect acts."""

from __future__ import annotations

import re
from collections.abc import Collection, Container
from dataclasses import dataclass
from itertools import combinations

from workers.effects.kinds import EffectForm, SiteKind
from workers.errors import EffectError
from workers.fmu.description import ModelDescription, nearest
from workers.messages import Interface

_PATTERNS: dict[SiteKind, str] = {
    "derivative": r"der\((.+)\)",
    "pair": r"pair (.+)",
    "input": r"input (.+)",
    "output": r"output (.+)",
    "parameter": r"parameter (.+)",
}
_COMMA = re.compile(r",(?![^\[]*\])")
"""A comma between two names, but not within square brackets as in "x[1,2]"."""


@dataclass(frozen=True)
class EffectSite:
    """A state derivative, a pair of them, an input, an output or a parameter, by the FMU's names.

    `other` is the second state of a pair.
    """

    kind: SiteKind
    target: str
    other: str = ""

    def __str__(self) -> str:
        if self.kind == "derivative":
            return f"der({self.target})"
        return f"{self.kind} {','.join(self.targets)}"

    @property
    def targets(self) -> tuple[str, ...]:
        return (self.target, self.other) if self.other else (self.target,)

    @property
    def at_rates(self) -> bool:
        """Whether an effect here is added to derivatives; elsewhere it replaces a signal."""
        return self.kind in ("derivative", "pair")


def parse_site(text: str, where: str) -> EffectSite:
    """Read "der(v)", "pair v,w", "input F", "output y" or "parameter k".

    Raises
    ------
    EffectError
        If the text has none of these forms.
    """
    for kind, pattern in _PATTERNS.items():
        found = re.fullmatch(pattern, text.strip())
        if found and kind != "pair":
            return EffectSite(kind, found.group(1).strip())
        if found:
            names = [name.strip() for name in _COMMA.split(found.group(1))]
            if len(names) == 2 and all(names) and names[0] != names[1]:
                return EffectSite(kind, *names)
            raise EffectError(
                f'{where}: must be "pair STATE,STATE" with two different states, but is {text!r}'
            )
    raise EffectError(
        f'{where}: must be "der(STATE)", "pair STATE,STATE", "input NAME", "output NAME" or '
        f'"parameter NAME", but is {text!r}'
    )


def open_sites(
    description: ModelDescription, interface: Interface, measured: Collection[str] = ()
) -> list[EffectSite]:
    """Return all sites that an FMU offers; in co-simulation, there are none at state derivatives.

    Variables in `measured` count as outputs, whatever causality the FMU declares for them.
    """
    variables = [v for v in description.variables.values() if v.alias_of is None]
    exchange = interface == "model_exchange"
    sites = [EffectSite("derivative", name) for name in description.states] if exchange else []
    sites += [EffectSite("input", v.name) for v in variables if v.causality == "input"]
    sites += [
        EffectSite("output", v.name)
        for v in variables
        if v.causality == "output" or (v.name in measured and v.is_computed)
    ]
    sites += [EffectSite("parameter", v.name) for v in variables if v.tunable]
    return sites


def open_pairs(description: ModelDescription, interface: Interface) -> list[EffectSite]:
    """Return all pairs of states of the same unit, between which a force can act.

    An effect at a pair may name any two states; a search tries only these pairs.
    """
    if interface == "co_simulation":
        return []
    return [
        EffectSite("pair", a, b)
        for a, b in combinations(description.states, 2)
        if description.variables[a].unit == description.variables[b].unit
    ]


def check_site(
    site: EffectSite, description: ModelDescription, interface: Interface, where: str
) -> None:
    """Check that the FMU offers a site.

    Raises
    ------
    EffectError
        If it does not. The message names the sites of the same kind that it offers.
    """
    offered = open_sites(description, interface, description.variables)
    parts = [EffectSite("derivative", s) for s in site.targets] if site.kind == "pair" else [site]
    missing = [part for part in parts if part not in offered]
    if not missing:
        return
    if site.at_rates and interface == "co_simulation":
        raise EffectError(
            f"{where}: {site} cannot be used, because a co-simulation FMU gives no access to its "
            'states; set model.interface = "model_exchange", or choose a site at an input, output '
            "or parameter"
        )
    if site.kind == "parameter" and site.target in description.variables:
        raise EffectError(
            f"{where}: {site} cannot be used, because {description.file} does not allow "
            f"{site.target!r} to change during a simulation (its variability is not tunable); "
            "choose another site"
        )
    known = [s.target for s in offered if s.kind == missing[0].kind]
    raise EffectError(
        f"{where}: {description.file} has no site {missing[0]}{nearest(missing[0].target, known)}"
    )


_MINUS = " - "


def difference(first: str, second: str) -> str:
    """Return the text of the difference of two variables."""
    return f"{first}{_MINUS}{second}"


def is_difference(text: str) -> bool:
    """Return whether a text looks like a difference; the name of a variable may look so too."""
    return _MINUS in text


def parts_of(text: str) -> list[str]:
    """Return the two names of a text that looks like a difference, otherwise the text."""
    return text.split(_MINUS)


def split_variable(text: str, known: Container[str]) -> tuple[str, ...]:
    """Return the name in a form's variable, the two names of a difference "v - w", or ().

    Names in FMUs may contain a minus, so `known` names are needed to find the operator.
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
    """Return a variable as it is written in an equation: a difference in brackets."""
    return f"({text})" if is_difference(text) else text


def own_variable(site: EffectSite) -> str:
    """Return the default variable of a form at derivatives: the state, or a pair's difference."""
    return difference(*site.targets) if site.other else site.target


def unnamed_variables(form: EffectForm, site: EffectSite) -> tuple[str, ...]:
    """Return the variables of a form if an effect does not name any."""
    return (own_variable(site),) if form.variables == 1 and site.at_rates else ()
