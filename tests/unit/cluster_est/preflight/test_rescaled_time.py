"""The key for times in another unit is written as the config may have it."""

from __future__ import annotations

from pathlib import Path

import pytest

from cluster_est.preflight.misread_units import _rescaled_time
from cluster_est.problem.tables.unused import TableSource


def table(time, sample_time):
    return TableSource("a", Path("a.csv"), time, sample_time, None, ())


@pytest.mark.parametrize(("source", "key"), [
    (table("Time", None), "columns.Time = { factor = 0.001 }"),
    (table("t (ms)", None), 'columns."t (ms)" = { factor = 0.001 }'),
    (table(None, 20.0), "sample_time = 0.02"),
    (None, "columns.COLUMN = { factor = 0.001 }, for the name of the time's column; or 0.001 "),
])  # fmt: skip
def test_it_names_the_column_where_that_is_known(source, key):
    assert _rescaled_time(source, 1e-3).startswith(key)
