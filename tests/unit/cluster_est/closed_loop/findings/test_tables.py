"""The findings of a closed loop as facts."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_est.closed_loop.findings.effects import ErrorChange
from cluster_est.closed_loop.findings.tables import errors_by_output


def change(experiment: str, samples: int, before: float, after: float) -> ErrorChange:
    return ErrorChange(experiment, "train", "y", "m", samples, before, after, before, after)


def test_an_experiment_without_samples_hides_no_error():
    empty = change("b", 0, np.nan, np.nan)
    found = errors_by_output([change("a", 100, 2.0, 1.0), empty])["y"]
    assert found["train"] == {"before": 2.0, "after": 1.0}
    assert np.isnan(errors_by_output([empty])["y"]["train"]["after"])


def test_one_that_fails_leaves_none():
    found = errors_by_output([change("a", 100, 2.0, 1.0), change("b", 100, 2.0, np.nan)])["y"]
    assert found["train"]["before"] == pytest.approx(2.0)
    assert np.isnan(found["train"]["after"])
