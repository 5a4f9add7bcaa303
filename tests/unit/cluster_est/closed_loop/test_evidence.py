"""Candidates and their evidence, as a row and under an old name."""

from __future__ import annotations

import pytest

from cluster_est.closed_loop.findings.tables import finding_table
from cluster_est.closed_loop.screening.evidence import CandidateEvidence, CandidateStage

EVIDENCE = CandidateEvidence(
    1, "der(v)", "viscous", "friction", ("v",), 0.0, 0, 0.0, 0.0, 1e-4, CandidateStage.SET_ASIDE,
    confounded_with="c",
)  # fmt: skip


def test_a_row_keeps_the_columns_that_findings_have_always_had():
    (row,) = finding_table([EVIDENCE]).to_pylist()
    assert (row["stage"], row["imitated_by"], row["variables"]) == ("set aside", "c", ["v"])
    assert row["distinct"] == 1e-4


def test_an_old_name_works_with_a_sentence():
    with pytest.warns(DeprecationWarning, match="confounded_with"):
        assert EVIDENCE.imitated_by == "c"
