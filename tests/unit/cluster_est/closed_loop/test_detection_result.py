"""What a detection says of a model, in a sentence."""

from __future__ import annotations

import pytest

from cluster_est.closed_loop.diagnostics import DetectionResult


@pytest.mark.parametrize(
    ("p", "p_white", "p_structure", "candidates", "said"),
    [
        (1e-5, 1e-5, 0.0025, 40, "something is missing (p = 1e-05 among 40 candidates)"),
        (0.0, 0.0, 0.0025, 1, "something is missing (p < 1e-300 among 1 candidate)"),
        (1e-5, 0.3, 0.0025, 40, "the residual is autocorrelated, tied to no candidate (p = 0.3)"),
        (0.3, 0.3, 0.0025, 40, "the residual has smooth structure (p = 0.0025)"),
        (0.3, 0.3, 0.5, 40, "nothing is missing that could be seen (p = 0.3)"),
        (1.0, 1.0, 0.5, 0, "the residual looks like noise (p = 0.5), but no candidate was"),
        (1.0, 1.0, 0.0025, 0, "has smooth structure (p = 0.0025), but no candidate was compared"),
    ],
)
def test_sentences(p, p_white, p_structure, candidates, said):
    found = DetectionResult(p, p_white, p_structure, candidates, {}, {}, 0.01)
    assert said in found.sentence


def test_what_the_solver_may_have_done_is_not_missing():
    found = DetectionResult(1e-5, 1e-5, 0.0025, 40, {}, {}, 0.01, "the step is too long")
    assert not found.missing
    assert found.sentence == "the step is too long"
