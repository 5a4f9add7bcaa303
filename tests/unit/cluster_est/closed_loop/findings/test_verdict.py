"""What is said of searches made by hand."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from support.truth.stacked_noise import stack

from cluster_est.closed_loop.findings.result import Verdict
from cluster_est.closed_loop.findings.verdict import judge
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.statistics.omnibus import OmnibusTest

RECORDS = stack(100, 100, 100, 100)
FLOOR = 400.0
QUIET, STRUCTURED = OmnibusTest(0.5, 0.1), OmnibusTest(0.0025, 30.0)


@dataclass(frozen=True)
class Case:
    """Sums of squares over those of the noise, and what was seen last."""

    base: float
    now: float
    why: str
    omnibus: OmnibusTest = QUIET
    families: tuple[str, ...] = ("friction",)
    left_out: float = np.nan
    white: OmnibusTest | None = None

    def search(self):
        before = np.full(4, self.base * FLOOR / 4)
        after = np.full(4, (self.now if np.isnan(self.left_out) else self.left_out) * FLOOR / 4)
        added = tuple(
            SimpleNamespace(form=SimpleNamespace(family=family)) for family in self.families
        )
        screening = SimpleNamespace(
            p=0.2, p_white=0.3, omnibus=self.omnibus, omnibus_white=self.white or self.omnibus
        )
        return SimpleNamespace(
            base=SimpleNamespace(sse=self.base * FLOOR, added=()),
            current=SimpleNamespace(sse=self.now * FLOOR, added=added),
            base_prediction=SimpleNamespace(squares=before, total=float(before.sum())),
            prediction=SimpleNamespace(squares=after, total=float(after.sum())),
            last=SimpleNamespace(why=self.why, screening=screening),
            noise=np.ones(1),
        )


CLEAN, LITTLE = "nothing significant", "it explains too little of what is missing"
CASES = {
    "nothing is missing": (Case(1.0, 1.0, CLEAN, families=()), Verdict.NONE),
    "structure, but no candidate": (
        Case(1.5, 1.5, CLEAN, STRUCTURED, ()), Verdict.UNEXPLAINED),
    "autocorrelation, and nothing else": (
        Case(1.5, 1.5, CLEAN, STRUCTURED, (), white=QUIET), Verdict.COLOURED),
    "structure below five percent": (Case(1.03, 1.03, CLEAN, STRUCTURED, ()), Verdict.NONE),
    "coloured noise": (Case(1.5, 1.5, "coloured noise", STRUCTURED, ()), Verdict.COLOURED),
    "a candidate was not accepted": (Case(1.01, 1.01, LITTLE, families=()), Verdict.NONE),
    "nothing explains it": (Case(4.0, 4.0, LITTLE, STRUCTURED, ()), Verdict.UNEXPLAINED),
    "all is explained": (Case(9.0, 1.0, CLEAN), Verdict.FOUND),
    "nearly all is explained": (Case(101.0, 1.5, LITTLE, STRUCTURED), Verdict.FOUND),
    "most is explained": (Case(9.0, 3.0, LITTLE, STRUCTURED), Verdict.PARTIAL),
    "most, but not in prediction": (
        Case(9.0, 3.0, LITTLE, STRUCTURED, left_out=5.0), Verdict.UNEXPLAINED),
    "a free table explains it": (
        Case(9.0, 1.0, CLEAN, families=("friction", "table")), Verdict.PARTIAL),
    "a free table explains most": (
        Case(9.0, 3.0, LITTLE, STRUCTURED, ("table",)), Verdict.UNEXPLAINED),
    "too little is explained": (Case(9.0, 6.0, LITTLE, STRUCTURED), Verdict.UNEXPLAINED),
    "the rest is coloured": (Case(9.0, 1.4, "coloured noise", STRUCTURED), Verdict.FOUND),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_verdicts(name):
    case, expected = CASES[name]
    bench = SimpleNamespace(
        records=RECORDS, settings=LoopSettings(), noise_floor=lambda noise: FLOOR
    )
    judgement = judge(bench, case.search())
    assert judgement.verdict is expected
    assert judgement.reason


def test_what_is_closed_is_the_lesser_of_training_and_prediction():
    bench = SimpleNamespace(
        records=RECORDS, settings=LoopSettings(), noise_floor=lambda noise: FLOOR
    )
    judgement = judge(bench, Case(9.0, 3.0, LITTLE, STRUCTURED, left_out=4.0).search())
    assert judgement.closed == pytest.approx(5.0 / 8.0)
    assert "62%" in judgement.reason
