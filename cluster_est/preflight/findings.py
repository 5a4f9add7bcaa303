"""The findings of a preflight."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

from cluster_est.results.output_errors import Simulation


class CheckVerdict(enum.StrEnum):
    """The result of a check, as it is printed."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"
    NOT_DONE = "not done"


@dataclass(frozen=True)
class CheckFinding:
    """The result of one check.

    Attributes
    ----------
    verdict
        A problem keeps a fit from its goal; a note is worth a thought.
    check
        Name of the check.
    found
        Its result, in numbers.
    do
        Advice, with the key of the config; empty if nothing needs to be done.
    """

    verdict: CheckVerdict
    check: str
    found: str
    do: str = ""


@dataclass(frozen=True)
class CheckPage:
    """All that a preflight found.

    Attributes
    ----------
    loads
        True if the FMU can be simulated at all.
    simulations
        Of the experiments at the start values, as far as there was time.
    """

    findings: tuple[CheckFinding, ...]
    simulations: tuple[Simulation, ...]
    loads: bool = True

    @property
    def good(self) -> bool:
        """True if there are no problems."""
        return not any(each.verdict is CheckVerdict.PROBLEM for each in self.findings)


MOST_LISTED = 5


def listed(texts: Sequence[str]) -> str:
    """Return the first of some texts in a row, and how many more there are."""
    more = len(texts) - MOST_LISTED
    return ", ".join(texts[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")
