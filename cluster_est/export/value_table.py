"""The values of a run as a table, which a spreadsheet opens and a config reads (`value_files`)."""

from __future__ import annotations

import csv
import io
import math

from cluster_est.export.repaired_model import EstimatedValue, RepairedModel

COLUMNS = ("name", "value", "unit", "low", "high")
"""`low` and `high` are the 95 % interval, empty where there is none."""


def value_table(repair: RepairedModel) -> bytes:
    """The document: estimates, coefficients of the effects, and known values."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for each in [*repair.parameters, *(value for own in repair.coefficients for value in own)]:
        rows.writerow([each.name, repr(float(each.value)), each.unit, *_interval(each)])
    for name, value in repair.known:
        shown = str(value).lower() if isinstance(value, bool) else value
        rows.writerow([name, shown, repair.description.variables[name].unit, "", ""])
    return text.getvalue().encode("utf-8")


def _interval(value: EstimatedValue) -> tuple[str, str]:
    low, high = value.low, value.high
    return ("", "") if math.isnan(low) else (repr(float(low)), repr(float(high)))
