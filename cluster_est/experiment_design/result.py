"""The result of a design: the input, and what the experiment is expected to tell."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.errors import RunFolderError
from cluster_est.experiment_design.expected import (
    expected_evidence,
    expected_precision,
    expected_probability,
    expected_table,
)
from cluster_est.experiment_design.expected_rows import (
    ExpectedEvidence,
    ExpectedPrecision,
    ExpectedProbability,
)
from cluster_est.experiment_design.search import CandidateScorer, ScoredCandidate, ranked
from cluster_est.experiment_design.sentences import (
    alike_sentences,
    evidence_sentence,
    narrowed_sentence,
)
from workers.fmu.description import nearest
from workers.messages import Experiment, FloatArray
from workers.messages.checks import check_text


@dataclass(frozen=True)
class DesignResult:
    """The next experiment.

    Attributes
    ----------
    experiment
        To be made: its inputs, and when its outputs are to be measured (their values are 0).
    chosen_starts
        Start values that were chosen, by the FMU's names.
    chosen
        The candidate that it is.
    criterion
        What it was chosen by, and what that is called.
    candidates
        All that were looked at.
    probabilities, evidence
        For every model, and every pair of models; empty where there is one.
    precision
        For every parameter that counts.
    expected
        What each model predicts of it: see `expected_table`.
    evaluations, simulated, failures, seconds
        Its cost.
    """

    experiment: Experiment
    chosen_starts: Mapping[str, float]
    chosen: ScoredCandidate
    criterion: tuple[str, str]
    candidates: tuple[ScoredCandidate, ...] = field(repr=False)
    probabilities: tuple[ExpectedProbability, ...]
    evidence: tuple[ExpectedEvidence, ...]
    precision: tuple[ExpectedPrecision, ...]
    expected: pa.Table = field(repr=False)
    evaluations: int = 0
    simulated: int = 0
    failures: int = 0
    seconds: float = 0.0

    @property
    def duration(self) -> float:
        """Seconds that the experiment takes."""
        return self.experiment.stop - self.experiment.start

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of its tables, those of a run folder's files."""
        return (
            "candidates", "probabilities", "evidence", "precision", "next_input", "expected",
        )  # fmt: skip

    def table(self, name: str) -> pa.Table:
        """One of `tables`.

        Raises
        ------
        RunFolderError
            If there is no such table.
        """
        check_text(name, "table", RunFolderError)
        if name == "candidates":
            return _candidate_table(self.candidates, self.chosen)
        if name == "probabilities":
            return _rows(ExpectedProbability, self.probabilities)
        if name == "evidence":
            return _rows(ExpectedEvidence, self.evidence)
        if name == "precision":
            return _rows(ExpectedPrecision, self.precision)
        if name == "next_input":
            return self.input_table()
        if name == "expected":
            return self.expected
        raise RunFolderError(
            f"table: must be one of the tables of a design but is {name!r}"
            f"{nearest(name, self.tables)}"
        )

    def input_table(self) -> pa.Table:
        """The time, a column for each designed input, and an empty one for each output.

        It is what `init` reads once the outputs have been measured.
        """
        designed = [given for given in self.experiment.inputs if self._is_designed(given.times)]
        times = self.experiment.outputs[0].times
        columns: dict[str, Any] = {"time": pa.array(times)}
        for given in designed:
            columns[given.variable] = pa.array(np.interp(times, given.times, given.values))
        for output in self.experiment.outputs:
            columns[output.variable] = pa.nulls(len(times), pa.float64())
        return pa.table(columns)

    def _is_designed(self, times: FloatArray) -> bool:
        return np.array_equal(times, self.experiment.outputs[0].times)

    @property
    def search_seconds(self) -> float:
        """Seconds that its simulations took, with what was computed from them."""
        return self.seconds

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what the experiment is expected to tell, and on what that rests."""
        found = [self.summary, *alike_sentences(self.evidence)]
        broken = [each for each in self.candidates if not each.ok]
        if broken:
            found.append(
                f"{len(broken)} of {len(self.candidates)} inputs would leave the limits with one "
                "of the models, or could not be simulated, and were not looked at further"
            )
        found.append(
            "what is expected rests on the models being exact, on what the uncertainty of "
            "their parameters does to the outputs being linear, and on noise as the run has found "
            "it, white; repeat the fit with the new data to know"
        )
        return tuple(found)

    @property
    def summary(self) -> str:
        """What was chosen, and what it is expected to tell, in a sentence."""
        how = self.chosen.candidate
        called = how.name if how.origin == "recorded" else how.waveform
        made = f"{called} of {self.duration:.4g} s"
        if self.chosen_starts:
            starts = [f"{name} = {value:.4g}" for name, value in self.chosen_starts.items()]
            made += f", beginning at {', '.join(starts)}"
        if self.evidence and self.criterion[0] == "discriminate":
            return f"{made}: {evidence_sentence(self.evidence)}"
        return f"{made}: {narrowed_sentence(self.precision)}"

    def facts(self) -> Mapping[str, Any]:
        """Return what run.json says of it, besides what the run's folder knows itself."""
        how = self.chosen.candidate
        return {
            "status": "done",
            "design": {
                "summary": self.summary,
                "criterion": self.criterion[0],
                "value": self.chosen.value,
                "called": self.criterion[1],
                "candidate": how.name,
                "waveform": how.waveform,
                "duration": self.duration,
                "start": dict(self.chosen_starts),
            },
            "notes": list(self.notes),
            "evaluations": self.evaluations,
            "simulations": self.simulated,
            "failures": self.failures,
            "seconds": self.seconds,
        }


def make_result(
    scorer: CandidateScorer, found: Sequence[ScoredCandidate], starts: Sequence[str]
) -> DesignResult:
    """Put what a search has found into words and tables; its cost is added by the caller.

    Parameters
    ----------
    scorer, found
        The scorer, and what it has scored.
    starts
        Names of the start values that were to be chosen.
    """
    best = ranked(found)[0]
    experiment = best.candidate.experiment
    known = dict(experiment.values)
    return DesignResult(
        experiment=experiment,
        chosen_starts={name: float(known[name]) for name in starts},
        chosen=best,
        criterion=(scorer.criterion.name, scorer.criterion.called),
        candidates=tuple(found),
        probabilities=expected_probability(scorer, found, best),
        evidence=expected_evidence(scorer, found, best),
        precision=expected_precision(scorer, found, best),
        expected=expected_table(scorer.models, best),
    )


def _candidate_table(candidates: Sequence[ScoredCandidate], chosen: ScoredCandidate) -> pa.Table:
    rows = [
        {
            "candidate": each.candidate.name,
            "waveform": each.candidate.waveform,
            "origin": each.candidate.origin,
            "duration": each.candidate.experiment.stop - each.candidate.experiment.start,
            "value": each.value,
            "violation": each.violation if math.isfinite(each.violation) else math.nan,
            "why": each.why,
            "chosen": each is chosen,
        }
        for each in candidates
    ]
    return pa.Table.from_pylist(rows)


def _rows(kind: type, rows: Sequence[Any]) -> pa.Table:
    """A table with a row for each, and with its columns where there are none."""
    if rows:
        return pa.Table.from_pylist([dataclasses.asdict(row) for row in rows])
    types = {"str": pa.string(), "float": pa.float64()}
    return pa.schema([(f.name, types[str(f.type)]) for f in dataclasses.fields(kind)]).empty_table()
