"""Where an effect acts."""

from __future__ import annotations

import re
from dataclasses import dataclass

from workers.description import Description, nearest
from workers.effects.forms import SiteKind
from workers.errors import EffectError
from workers.messages import Interface

_PATTERNS: dict[SiteKind, str] = {
    "derivative": r"der\((.+)\)",
    "input": r"input (.+)",
    "output": r"output (.+)",
    "parameter": r"parameter (.+)",
}


@dataclass(frozen=True)
class Site:
    """A state derivative, an input, an output or a parameter of the FMU, by the FMU's name."""

    kind: SiteKind
    target: str

    def __str__(self) -> str:
        return f"der({self.target})" if self.kind == "derivative" else f"{self.kind} {self.target}"


def parse_site(text: str, where: str) -> Site:
    """Read "der(v)", "input F", "output y" or "parameter k".

    Raises
    ------
    EffectError
        If it is none of these.
    """
    for kind, pattern in _PATTERNS.items():
        found = re.fullmatch(pattern, text.strip())
        if found:
            return Site(kind, found.group(1).strip())
    raise EffectError(
        f'{where}: must be "der(STATE)", "input NAME", "output NAME" or "parameter NAME" but is '
        f"{text!r}"
    )


def open_sites(description: Description, interface: Interface) -> list[Site]:
    """Every site that an FMU offers: a co-simulation FMU keeps its state derivatives to itself."""
    variables = description.variables.values()
    exchange = interface == "model_exchange"
    sites = [Site("derivative", name) for name in description.states] if exchange else []
    sites += [Site("input", v.name) for v in variables if v.causality == "input"]
    sites += [Site("output", v.name) for v in variables if v.causality == "output"]
    sites += [Site("parameter", v.name) for v in variables if v.tunable]
    return sites


def check_site(site: Site, description: Description, interface: Interface, where: str) -> None:
    """Refuse a site that the FMU does not offer.

    Raises
    ------
    EffectError
        With the sites of that kind that it does offer.
    """
    offered = open_sites(description, interface)
    if site in offered:
        return
    if site.kind == "derivative" and interface == "co_simulation":
        raise EffectError(
            f"{where}: {site} is closed, because a co-simulation FMU keeps its states to itself; "
            'use model.interface = "model_exchange" or a site at an input, output or parameter'
        )
    if site.kind == "parameter" and site.target in description.variables:
        raise EffectError(
            f"{where}: {site} is closed, because {description.file} does not allow "
            f"{site.target!r} to change while it runs (its variability is not tunable)"
        )
    known = [s.target for s in offered if s.kind == site.kind]
    raise EffectError(
        f"{where}: {description.file} has no such site {site}{nearest(site.target, known)}"
    )
