"""What is said of outputs that a fitted model does not follow."""

from __future__ import annotations

import math

from cluster_est.results.output_errors import OutputError, worse_than_constants


def error(experiment: str, output: str, relative: float, role: str = "train") -> OutputError:
    return OutputError(experiment, role, output, "K", 9, 1.0, 1.0, 1.0, relative, 1.0, 1.0)


def test_an_output_that_a_constant_would_follow_better_is_named_once_with_its_worst():
    found = worse_than_constants(
        [
            error("a", "T", 1.5),
            error("b", "T", 5.91),
            error("a", "p", 0.99),
            error("a", "level", math.inf),  # a constant was measured
            error("a", "flow", math.nan),
            error("c", "p", 7.0, role="test"),
        ]
    )
    assert len(found) == 1
    assert "follow T better" in found[0]
    assert "its error in b is 5.91 times" in found[0]
