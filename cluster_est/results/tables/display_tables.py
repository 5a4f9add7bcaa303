"""Estimates and errors as notebooks and `print` show them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cluster_est.problem import display
from cluster_est.results.tables.row_types import Estimate
from cluster_est.statistics.residual_findings import ResidualDiagnostics


def fit_tables(
    estimates: Sequence[Estimate],
    errors: Sequence[Any],
    diagnostics: ResidualDiagnostics | None = None,
) -> tuple[display.DisplayTable, display.DisplayTable]:
    """Estimates and errors, of a fit or of a closed loop, as a notebook shows them.

    Where diagnostics deny the intervals, a word beside them says so.
    """
    too_narrow = diagnostics is not None and diagnostics.too_narrow
    ends = ("95 % from", "to (too narrow)" if too_narrow else "to")
    values = [
        (e.label, e.value, e.unit, e.std_error, e.lower95, e.upper95, e.at_bound) for e in estimates
    ]
    fits = [(e.experiment, e.role, e.output, e.rmse_before, e.rmse_after, e.unit) for e in errors]
    return (
        display.DisplayTable(
            "Parameters",
            ("parameter", "value", "unit", "standard error", *ends, "at bound"),
            values,
        ),
        display.DisplayTable(
            "Root mean square errors",
            ("experiment", "role", "output", "before", "after", "unit"),
            fits,
        ),
    )
