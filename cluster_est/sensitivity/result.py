"""The result of a sensitivity analysis: its tables, its facts, and what to know of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.errors import RunFolderError
from cluster_est.problem.problem import Problem
from cluster_est.sensitivity.quantities import COST, LOG_COST
from cluster_est.sensitivity.settings import SensitivitySettings
from workers.fmu.description import nearest
from workers.messages.checks import check_text
from workers.messages.equality import by_content

MOST_NAMED = 5
"""Unknowns that a sentence names."""

UNSETTLED = 0.5
"""Part of the largest index of the cost that is a wide interval."""


@dataclass(frozen=True)
class IndexRow:
    """One index of one unknown, a row of indices.parquet.

    `output` is "cost", "log(cost)" or an output's name, with the experiment and the time that the
    index is of; `half_width` is that of its 95 % interval.
    """

    label: str
    index: str
    output: str
    experiment: str
    time: float
    value: float
    half_width: float


@dataclass(frozen=True)
class RankedUnknown:
    """One unknown, a row of ranking.parquet; the one that moves the cost the most is first.

    Attributes
    ----------
    label
        Such as "k".
    value, half_width
        The index of the cost that ranks it.
    size
        Root mean square of the sensitivities of the residuals at the start values, for a noticeable
        change, in sigmas.
    position
        Its place in the order in which unknowns are best estimated, from 0; -1 where no
        derivatives were had.
    collinearity
        With those before it in that order.
    together
        Whether it may be estimated together with those before it.
    """

    label: str
    value: float
    half_width: float
    size: float = np.nan
    position: int = -1
    collinearity: float = np.nan
    together: bool = True


@by_content
@dataclass(frozen=True)
class SensitivityResult:
    """What a sensitivity analysis has found.

    Attributes
    ----------
    problem, settings, seed
        What was analysed, and how.
    ranks
        What unknowns are ranked by, such as "mu* of log(cost)".
    ranking
        All unknowns, the one that moves the cost the most first.
    indices
        Of all quantities.
    groups, lost
        Of points that were simulated, and how many of them a failure has taken away.
    evaluations, simulated, failures
        Of points, simulations and those that failed.
    seconds
        From start to end.
    why_no_order
        Why there is no order of estimation; "" where there is one.
    """

    problem: Problem = field(repr=False)
    settings: SensitivitySettings
    seed: int
    ranks: str
    ranking: tuple[RankedUnknown, ...]
    indices: tuple[IndexRow, ...] = field(repr=False)
    groups: int
    lost: int
    evaluations: int
    simulated: int
    failures: int
    seconds: float
    why_no_order: str = ""

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of its tables, those of a run folder's files."""
        return ("ranking", "indices")

    def table(self, name: str) -> pa.Table:
        """One of `tables`.

        Raises
        ------
        RunFolderError
            If there is no such table.
        """
        check_text(name, "table", RunFolderError)
        rows: dict[str, Sequence[Any]] = {"ranking": self.ranking, "indices": self.indices}
        if name not in rows:
            raise RunFolderError(
                f"table: must be one of the tables of a sensitivity analysis but is {name!r}"
                f"{nearest(name, self.tables)}"
            )
        return pa.Table.from_pylist([dataclasses.asdict(row) for row in rows[name]])

    @property
    def search_seconds(self) -> float:
        """Seconds that its simulations took, with what was computed from them."""
        return self.seconds

    def facts(self) -> Mapping[str, Any]:
        """Return what run.json says of it, besides what the run's folder knows itself."""
        return {
            "status": "done",
            "sensitivity": {
                "method": self.settings.method,
                "ranks": self.ranks,
                "groups": self.groups,
                "lost": self.lost,
                "together": [u.label for u in self.ranking if u.together and u.position >= 0],
            },
            "notes": list(self.notes),
            "evaluations": self.evaluations,
            "simulations": self.simulated,
            "failures": self.failures,
            "seconds": self.seconds,
        }

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on failures, on how settled the ranking is, and on what goes together."""
        found = list(self.problem.notes())
        if self.lost:
            found.append(
                f"{self.lost} of {self.groups} groups of points had a simulation that failed, or "
                "no finite cost, and count for nothing: the indices are those of the part of the "
                "bounds that can be simulated"
            )
        if not self._largest:
            found.append("nothing moves the cost between the bounds")
        wide = [u.label for u in self.ranking if u.half_width > UNSETTLED * self._largest]
        if wide:
            found.append(
                f"the intervals of {_named(wide)} are wide beside the largest index: take more "
                "sensitivity.groups before you rank by them"
            )
        if self._largest and not any(row.output not in (COST, LOG_COST) for row in self.indices):
            found.append("only the cost was analysed, and no output over time")
        if self.why_no_order:
            found.append(self.why_no_order)
        apart = [u for u in self.ranking if not u.together and np.isfinite(u.collinearity)]
        unseen = [u.label for u in self.ranking if u.collinearity == np.inf]
        if apart:
            labels = _named([u.label for u in apart])
            found.append(
                f"at the start values {labels} cannot be told from the unknowns before "
                f"{'it' if len(apart) == 1 else 'them'} in the order of estimation (collinearity "
                f"index of {min(u.collinearity for u in apart):.3g} or more): fix "
                f"{'it' if len(apart) == 1 else 'them'} (fixed = true), where the value is known "
                "well enough, or measure what tells them apart"
            )
        if unseen:
            found.append(
                f"at the start values the residuals do not depend on {_named(unseen)}, or no more "
                "than others make up for"
            )
        return tuple(found)

    @property
    def _largest(self) -> float:
        values = [u.value for u in self.ranking if np.isfinite(u.value)]
        return max(values, default=0.0)


def _named(labels: Sequence[str]) -> str:
    """Some labels, and how many more there are."""
    shown = ", ".join(labels[:MOST_NAMED])
    more = len(labels) - MOST_NAMED
    return f"{shown} and {more} more" if more > 0 else shown
