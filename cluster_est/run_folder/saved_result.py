"""A result in a run folder, as read by `ce.load`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa
from typing_extensions import override

from cluster_est.errors import ProblemError, RunFolderError
from cluster_est.results.criteria import InformationCriteria
from cluster_est.results.view import ResultView, short_text
from cluster_est.run_folder.run_files import check_has_estimates, read_facts, read_run_columns
from workers.fmu.description import nearest
from workers.messages.checks import as_path

OF_THE_RUN = ("searches", "workers")
"""Tables that only a run with a log has; a result in memory has none of them."""


@dataclass(frozen=True, repr=False)
class SavedResult(ResultView):
    """A fit or a closed loop that was saved by `save` or by a command.

    It has the same names, tables and plots as the original result. Operations that need the problem
    and the FMU, such as another fit, are not available.

    Attributes
    ----------
    path
        The run folder.
    """

    path: Path

    @property
    @override
    def tables(self) -> tuple[str, ...]:
        names = sorted(each.stem for each in self.path.glob("*.parquet"))
        return tuple(name for name in names if name not in OF_THE_RUN)

    @override
    def table(self, name: str) -> pa.Table:
        path = self.path / f"{name}.parquet"
        if not path.is_file():
            raise RunFolderError(
                f"table: must be one of the tables in {self.path}, but is "
                f"{name!r}{nearest(name, self.tables)}"
            )
        return read_run_columns(path)

    @override
    def facts(self) -> Mapping[str, Any]:
        return self._facts

    @cached_property
    def _facts(self) -> Mapping[str, Any]:
        return read_facts(self.path)

    @cached_property
    @override
    def criteria(self) -> InformationCriteria:
        return InformationCriteria.from_facts(self._facts.get("criteria"))

    @property
    def success(self) -> bool:
        """True if the search reached a solution."""
        return bool(self._facts["status"] == "done")

    @property
    def message(self) -> str:
        """The reason why the search ended, or the summary of a closed loop."""
        return str(self._facts.get("summary") or self._facts["message"])

    @property
    def x(self) -> dict[str, float]:
        """Estimated physical values by label."""
        searched = ("train", "test")
        return {e.label: e.value for e in self.params.values() if e.estimated_on in searched}

    @property
    def cost(self) -> float:
        """Cost of the training experiments at the estimates."""
        return float(self._facts["cost"])

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that a reader should know."""
        return tuple(self._facts.get("notes") or ())

    def __repr__(self) -> str:
        return short_text("SavedResult", f"{self.path}", self.x)


def load(folder: str | Path) -> SavedResult:
    """Return the result in a run folder, written by `save` or by the commands fit and close-loop.

    Raises
    ------
    RunFolderError
        If it is not a run folder, or if its run has no estimates.
    """
    path = as_path(folder, "folder", ProblemError)
    check_has_estimates(path)
    if not (path / "parameters.parquet").is_file():
        status = read_facts(path)["status"]
        raise RunFolderError(
            f"{path}: must be a run with results, but its status is {status}; wait for it, or "
            "resume it"
        )
    return SavedResult(path)
