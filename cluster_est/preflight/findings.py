"""What a preflight finds: a line each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cluster_est.results.output_errors import Simulation

Verdict = Literal["ok", "note", "problem", "not done"]


@dataclass(frozen=True)
class CheckFinding:
    """The result of one check.

    Attributes
    ----------
    verdict
        A "problem" keeps a fit from its goal; a "note" is worth a thought.
    check
        What was looked at.
    found
        In numbers.
    do
        What can be done, with the key of the config; empty if nothing needs to be.
    """

    verdict: Verdict
    check: str
    found: str
    do: str = ""


@dataclass(frozen=True)
class CheckPage:
    """All that a preflight found.

    Attributes
    ----------
    loads
        Whether the FMU is there to be simulated at all.
    simulations
        Of the experiments at the start values, as far as there was time.
    """

    findings: tuple[CheckFinding, ...]
    simulations: tuple[Simulation, ...]
    loads: bool = True

    @property
    def good(self) -> bool:
        return not any(each.verdict == "problem" for each in self.findings)
