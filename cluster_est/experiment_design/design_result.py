"""The result of a design: the input, and the expected information of the experiment."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.errors import RunFolderError
from cluster_est.experiment_design.candidate_inputs import (
    RANDOM,
    RECORDED,
    SMALLER_AMPLITUDES,
    CandidateMaker,
)
from cluster_est.experiment_design.criteria import (
    covariances,
    expected_probabilities,
    prediction_variances,
)
from cluster_est.experiment_design.design_sentences import (
    STEM,
    TABLE,
    ExpectedEvidence,
    ExpectedPrecision,
    ExpectedPredictionError,
    ExpectedProbability,
    alike_sentences,
    evidence_sentence,
    experiment_block,
    narrowed_sentence,
    predicted_sentence,
)
from cluster_est.experiment_design.input_search import (
    CandidateScorer,
    ScoredCandidate,
    SearchedCandidates,
    ranked,
)
from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.results.fit_tables import coefficient_units
from workers.fmu.description import nearest
from workers.grid import values_at
from workers.messages import Experiment, FloatArray
from workers.messages.checks import check_text
from workers.messages.types import by_content


def expected_table(models: Sequence[FittedCandidate], best: ScoredCandidate) -> pa.Table:
    """Return each model's prediction of each output, with the error due to its parameters."""
    experiment = best.candidate.experiment
    columns: dict[str, list[Any]] = {
        name: [] for name in ("model", "output", "time", "expected", "std_error")
    }
    for fitted, predicted in zip(models, best.predicted, strict=True):
        errors = np.sqrt(np.sum(predicted.factor**2, axis=1))
        first = 0
        for output in experiment.outputs:
            count = len(output.times)
            rows = slice(first, first + count)
            columns["model"] += [fitted.model.name] * count
            columns["output"] += [output.variable] * count
            columns["time"] += output.times.tolist()
            columns["expected"] += (output.sigma * predicted.outputs[rows]).tolist()
            columns["std_error"] += (output.sigma * errors[rows]).tolist()
            first += count
    return pa.table(columns)


def expected_evidence(
    scorer: CandidateScorer, found: Sequence[ScoredCandidate], own: FloatArray
) -> tuple[ExpectedEvidence, ...]:
    """Return the evidence for every pair of models; empty for a single model.

    `own` is the evidence of the chosen input, (true model, rival).
    """
    if len(scorer.models) < 2:
        return ()
    names = [fitted.model.name for fitted in scorer.models]
    random, recorded = _compared(found, lambda each: each.evidence)
    most = np.maximum(np.max([each.evidence for each in ranked(found)], axis=0), own)
    return tuple(
        ExpectedEvidence(
            names[i],
            names[j],
            *(float(each[i, j]) for each in (own, random, recorded, most)),
        )
        for i in range(len(names))
        for j in range(len(names))
        if i != j
    )


def expected_probability(
    scorer: CandidateScorer, found: Sequence[ScoredCandidate], own: FloatArray
) -> tuple[ExpectedProbability, ...]:
    """Return the probability of every model, if it is true; empty for a single model."""
    if len(scorer.models) < 2:
        return ()
    weights = np.array([fitted.model.weight for fitted in scorer.models])

    def expected(each: ScoredCandidate) -> FloatArray:
        return expected_probabilities(each.evidence, weights)

    after = expected_probabilities(own, weights)
    columns = (weights / np.add.reduce(weights), after, *_compared(found, expected))
    return tuple(
        ExpectedProbability(fitted.model.name, *(float(column[i]) for column in columns))
        for i, fitted in enumerate(scorer.models)
    )


def expected_precision(
    scorer: CandidateScorer,
    found: Sequence[ScoredCandidate],
    best: ScoredCandidate,
    units: Mapping[str, str],
) -> tuple[ExpectedPrecision, ...]:
    """Return the standard error of every parameter that counts, before and after."""
    fitted, labels = scorer.models[0], scorer.parameters
    units = {**units, **coefficient_units(fitted.space.problem)}

    def errors(each: ScoredCandidate) -> FloatArray:
        after = covariances(fitted, each.predicted[0], labels)[1]
        return np.sqrt(np.diag(after))

    before = np.sqrt(np.diag(covariances(fitted, best.predicted[0], labels)[0]))
    after = errors(best)
    random, recorded = _compared(found, errors)
    rows = []
    for place, label in enumerate(labels):
        i = fitted.labels.index(label)
        unknown, searched = fitted.space.unknowns[i], float(fitted.x[i])
        step = 1e-6 * max(abs(searched), 1.0)
        ends = unknown.to_physical(searched + step), unknown.to_physical(searched - step)
        slope = abs(ends[0] - ends[1]) / (2.0 * step)
        rows.append(
            ExpectedPrecision(
                label,
                unknown.parameter.unit or units.get(unknown.parameter.target, ""),
                unknown.to_physical(searched),
                *(slope * float(each[place]) for each in (before, after, random, recorded)),
            )
        )
    return tuple(rows)


def expected_predictions(
    scorer: CandidateScorer, found: Sequence[ScoredCandidate], best: ScoredCandidate
) -> tuple[ExpectedPredictionError, ...]:
    """Return the standard deviation of every prediction that counts, before and after."""
    fitted = scorer.models[0]
    if not fitted.targets:
        return ()

    def errors(each: ScoredCandidate) -> FloatArray:
        return np.sqrt(prediction_variances(fitted, each.predicted[0])[1])

    before = np.sqrt(prediction_variances(fitted, best.predicted[0])[0])
    columns = (before, errors(best), *_compared(found, errors))
    return tuple(
        ExpectedPredictionError(
            each.experiment, each.output, each.unit, *(float(column[i]) for column in columns)
        )
        for i, each in enumerate(fitted.targets)
    )


def _compared(
    found: Sequence[ScoredCandidate], measure: Callable[[ScoredCandidate], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return a measure of the median random input and of the best recorded one; NaN without any."""
    nothing = np.full(measure(ranked(found)[0]).shape, np.nan)
    random = ranked(
        [each for each in found if each.candidate.origin in (RANDOM, SMALLER_AMPLITUDES)]
    )
    recorded = ranked([each for each in found if each.candidate.origin == RECORDED])
    return (
        measure(random[len(random) // 2]) if random else nothing,
        measure(recorded[0]) if recorded else nothing,
    )


@by_content
@dataclass(frozen=True)
class DesignResult:
    """The next experiment.

    Attributes
    ----------
    experiment
        The experiment to make: its inputs, and the times of its outputs (their values are 0).
    designed, chosen_starts
        Names of the designed inputs, and chosen start values.
    like
        The experiment of the run whose start it has.
    chosen
        The chosen candidate.
    criterion
        The criterion, and the name of its value.
    candidates
        All candidates.
    probabilities, evidence
        For every model, and every pair of models; empty for a single model.
    precision
        For every parameter that counts.
    predictions
        For every output to predict; empty for other criteria than "v".
    expected
        Predictions of each model: see `expected_table`.
    remarks
        Sentences on the fits on which it is based, and on the search.
    units
        The FMU's units of its inputs, signals and outputs, if declared.
    evaluations, simulated, failures, seconds
        Its cost.
    """

    experiment: Experiment
    designed: tuple[str, ...]
    chosen_starts: Mapping[str, float]
    like: Experiment = field(repr=False)
    chosen: ScoredCandidate
    criterion: tuple[str, str]
    candidates: tuple[ScoredCandidate, ...] = field(repr=False)
    probabilities: tuple[ExpectedProbability, ...]
    evidence: tuple[ExpectedEvidence, ...]
    precision: tuple[ExpectedPrecision, ...]
    expected: pa.Table = field(repr=False)
    predictions: tuple[ExpectedPredictionError, ...] = ()
    remarks: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    evaluations: int = 0
    simulated: int = 0
    failures: int = 0
    seconds: float = 0.0

    @property
    def duration(self) -> float:
        """Duration of the experiment in seconds."""
        return self.experiment.stop - self.experiment.start

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of its tables, which are files of a run folder."""
        return (
            "candidates", "probabilities", "evidence", "precision", "prediction_precision",
            "next_input", "expected",
        )  # fmt: skip

    def table(self, name: str) -> pa.Table:
        """Return one of `tables`.

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
        if name == "prediction_precision":
            return _rows(ExpectedPredictionError, self.predictions)
        if name == "next_input":
            return self.input_table()
        if name == "expected":
            return self.expected
        raise RunFolderError(
            "table: must be one of the tables of this design, but is "
            f"{name!r}{nearest(name, self.tables)}"
        )

    def input_table(self) -> pa.Table:
        """Return the time, a column for each input and signal, and an empty one for each output.

        A config reads this table when the outputs have been measured.
        """
        times = self.experiment.outputs[0].times
        columns: dict[str, Any] = {"time": pa.array(times)}
        for given in (*self.experiment.inputs, *self.experiment.signals):
            columns[given.variable] = pa.array(values_at(given, times))
        for output in self.experiment.outputs:
            columns[output.variable] = pa.nulls(len(times), pa.float64())
        return pa.table(columns)

    def experiment_block(self, data: str) -> str:
        """Return an entry of `[[experiments]]` for the table, to paste into the config.

        Parameters
        ----------
        data
            Path of the table, relative to the config's folder.
        """
        return experiment_block(self.experiment, data, Path(data).stem)

    @property
    def search_seconds(self) -> float:
        """Duration of its simulations and of the computations from them, in seconds."""
        return self.seconds

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on the expected information of the experiment, and on its basis."""
        found = [self.summary]
        if self._discriminates:
            found += alike_sentences(self.evidence, len(self.candidates))
        broken = [each for each in self.candidates if not each.ok]
        if broken:
            found.append(
                f"{len(broken)} of {len(self.candidates)} inputs were rejected, because they could "
                "not be simulated, or because they violate the limits in at least one model, "
                "either at its estimates or with parameters one standard deviation away"
            )
        found += self._repeated
        found.append(
            "the expected values assume that the models are exact, that the uncertainty of their "
            "parameters has a linear effect on the outputs, and that the noise is the same as in "
            "the run; fit again with the new data"
        )
        return (*found, *self.remarks)

    @property
    def _repeated(self) -> list[str]:
        """Return what is repeated from the similar experiment, and for how long."""
        kept = [g.variable for g in self.experiment.inputs if g.variable not in self.designed]
        kept += [g.variable for g in self.experiment.signals]
        if not kept:
            return []
        longer = self.duration > (self.like.stop - self.like.start) * (1.0 + 1e-9)
        end = ", and keep their last values beyond its end" if longer else ""
        return [f"{', '.join(kept)}: taken from {self.like.id}{end}"]

    @property
    def _discriminates(self) -> bool:
        return bool(self.evidence) and self.criterion[0] == "discriminate"

    @property
    def summary(self) -> str:
        """The chosen input and its expected information, in a sentence."""
        how = self.chosen.candidate
        called = how.name if how.origin == RECORDED else how.waveform
        made = f"{called}, {self.duration:.4g} s"
        if self.chosen_starts:
            starts = [f"{name} = {value:.4g}" for name, value in self.chosen_starts.items()]
            made += f", beginning at {', '.join(starts)}"
        if self._discriminates:
            said = evidence_sentence(self.evidence, self.probabilities, len(self.candidates))
            return f"{made}: {said}"
        if self.predictions:
            return f"{made}: {predicted_sentence(self.predictions)}"
        return f"{made}: {narrowed_sentence(self.precision)}"

    def facts(self) -> Mapping[str, Any]:
        """Return the contents of run.json for this result."""
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
                "units": dict(self.units),
                "block": experiment_block(self.experiment, TABLE, STEM),
            },
            "notes": list(self.notes),
            "evaluations": self.evaluations,
            "simulations": self.simulated,
            "failures": self.failures,
            "seconds": self.seconds,
        }


def make_result(
    scorer: CandidateScorer,
    found: SearchedCandidates,
    maker: CandidateMaker,
    chosen: tuple[ScoredCandidate, FloatArray],
    units: Mapping[str, str],
) -> DesignResult:
    """Return the result of a search as texts and tables; the caller adds its cost.

    Parameters
    ----------
    scorer, found, maker
        The scorer of candidates, all candidates, and their maker.
    chosen
        The chosen candidate, and its evidence, (true model, rival).
    units
        Units of the FMU's variables, by name.
    """
    best, evidence = chosen
    experiment = best.candidate.experiment
    given = [each.variable for each in (*experiment.inputs, *experiment.signals)]
    names = [*given, *(each.variable for each in experiment.outputs)]
    known = dict(experiment.values)
    remarks = [note for model in scorer.models for note in model.notes]
    if len(found.scored) < found.wanted:
        remarks.append(f"the budget was used up after {len(found.scored)} of {found.wanted} inputs")
    return DesignResult(
        experiment=experiment,
        designed=tuple(maker.limits.inputs),
        chosen_starts={name: float(known[name]) for name in maker.limits.start},
        like=maker.like,
        chosen=best,
        criterion=(scorer.criterion.name, scorer.criterion.called),
        candidates=found.scored,
        probabilities=expected_probability(scorer, found.scored, evidence),
        evidence=expected_evidence(scorer, found.scored, evidence),
        precision=expected_precision(scorer, found.scored, best, units),
        predictions=expected_predictions(scorer, found.scored, best),
        expected=expected_table(scorer.models, best),
        remarks=tuple(remarks),
        units={name: units.get(name, "") for name in names},
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
    """Return a table with a row for each object; without rows, it still has its columns."""
    if rows:
        return pa.Table.from_pylist([dataclasses.asdict(row) for row in rows])
    types = {"str": pa.string(), "float": pa.float64()}
    return pa.schema([(f.name, types[str(f.type)]) for f in dataclasses.fields(kind)]).empty_table()
