"""The result of a search for missing effects."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pyarrow as pa
from typing_extensions import override

from cluster_est.closed_loop.findings.competing_models import (
    CompetingModel,
    likely_sentence,
    likely_structures,
)
from cluster_est.closed_loop.findings.effects import (
    ErrorChange,
    NamedEffect,
    NoiseChange,
    Verdict,
    comparable,
    config_block,
    pooled_error,
)
from cluster_est.closed_loop.findings.unexplained import UnexplainedResidual
from cluster_est.closed_loop.screening.screen import CandidateEvidence
from cluster_est.closed_loop.selection.rounds import ComparedStructure
from cluster_est.problem.problem import Problem
from cluster_est.results.criteria import InformationCriteria
from cluster_est.results.facts import fit_facts
from cluster_est.results.fit_tables import EffectCurve, Estimate
from cluster_est.results.output_errors import OutputError
from cluster_est.results.result import Result
from cluster_est.results.shapes.effect_table import curve_table
from cluster_est.results.view import ResultView, short_text
from workers.messages import FloatArray, Role
from workers.messages.types import by_content


class ErrorScale(enum.StrEnum):
    """The divisor of normalised errors, with its text in run.json."""

    SIGMA = "sigma"
    ESTIMATED_NOISE = "estimated noise"
    PREDICTED = "predicted spread"


@by_content
@dataclass(frozen=True, repr=False)
class LoopResult(ResultView):
    """The result of a search for missing effects.

    The attributes that it shares with `Result` are those of the last fit.

    Attributes
    ----------
    verdict, message
        The verdict, and the summary as a paragraph.
    effects
        The effects that were added; empty unless the verdict is "found" or "partial".
    before, after
        Fits of the declared model and of the model with the effects. They are the same fit if
        nothing was added.
    errors
        Errors of each output of each experiment.
    findings
        All candidates of all steps.
    rejected
        If the verdict is "unexplained", the leads: effects that were not accepted, or the effects
        of the best set that was tried. `claim` says how often such leads were right.
    noise
        Standard deviation of each output's noise, in the output's unit, estimated from the last
        residuals. Without a declared sigma, errors are divided by the estimate from the residuals
        of the declared model, so that they can be compared before and after. Empty with
        process noise, where the given sigma is used.
    sites
        The sites that were searched.
    notes
        Notes for the reader, such as no held-out experiment, or a sigma that contradicts the noise.
    simulations
        Number of simulations, in units of one experiment's full length.
    simulated, evaluations, failures, seconds
        Numbers of simulated experiments, evaluated points and failed simulations; duration.
    curves
        Curves of the added effects.
    errors_over
        The divisor of the normalised errors.
    structures
        All sets of effects that were refitted: the path of the search. If the verdict is "found",
        they have probabilities; `likely` has the sets with 90 % of the probability.
    failures_in_search
        Number of failures while effects were tried. If the model cannot be simulated with an
        effect, the effect is not used.
    unexplained
        The part of each output's residual beyond its noise, if the verdict is "partial" or
        "unexplained": its size and period. The part that is largest over its noise comes first.
    resampled
        A sentence on how often the effects are chosen in resamplings of the training experiments;
        "" if that is not known.
    competing
        The fitted model that was found, and the rivals that the data do not exclude. `design` plans
        an experiment that distinguishes them. Empty if nothing was added, and with process noise.
    process_noise
        Strength of the process noise before and after; empty if nothing was added.
    first
        What the summary asks to do before everything else, such as "correct the records"; "" if it
        asks for nothing.
    left_out
        Times of the samples that were left out as outliers, by experiment and output. The key
        `left_out` of an experiment takes these times.
    """

    verdict: Verdict
    message: str
    effects: tuple[NamedEffect, ...]
    before: Result
    after: Result
    errors: tuple[ErrorChange, ...]
    findings: tuple[CandidateEvidence, ...]
    rejected: tuple[NamedEffect, ...]
    noise: dict[str, float]
    sites: tuple[str, ...]
    notes: tuple[str, ...]
    simulations: float
    simulated: int
    evaluations: int
    failures: int
    seconds: float
    curves: tuple[EffectCurve, ...] = ()
    errors_over: ErrorScale = ErrorScale.SIGMA
    structures: tuple[ComparedStructure, ...] = ()
    unexplained: tuple[UnexplainedResidual, ...] = ()
    failures_in_search: int = 0
    resampled: str = ""
    competing: tuple[CompetingModel, ...] = ()
    process_noise: tuple[NoiseChange, ...] = ()
    first: str = ""
    left_out: Mapping[str, Mapping[str, Sequence[float]]] = dataclasses.field(default_factory=dict)

    def rms(self, role: Role, when: Literal["before", "after"]) -> float:
        """Return the root mean square of the normalised errors before or after; NaN if unknown.

        It is taken over the experiments that could be simulated both before and after.
        """
        return pooled_error(comparable(self.errors), role, after=when == "after")

    @property
    def likely(self) -> tuple[ComparedStructure, ...]:
        """The fewest sets of effects with 90 % of the probability, and the set that was added.

        The likeliest set comes first; the declared model may be one of them. Empty unless the
        verdict is "found": otherwise the part that is still missing could change their order.
        """
        return likely_structures(self.structures)

    @property
    def problem(self) -> Problem:
        return self.after.problem

    @property
    def success(self) -> bool:
        """Whether the last fit converged; `verdict` says what was found."""
        return self.after.success

    @property
    def x(self) -> dict[str, float]:
        """Physical values by label, including the coefficients of the effects."""
        return self.after.x

    @property
    def cost(self) -> float:
        return self.after.cost

    @property
    def fun(self) -> FloatArray | None:
        return self.after.fun

    @property
    def jac(self) -> FloatArray | None:
        return self.after.jac

    @property
    def nfev(self) -> int:
        """Number of evaluated points."""
        return self.evaluations

    @property
    def nit(self) -> int:
        return self.after.nit

    @property
    def final(self) -> Result:
        """The fit with the effects; its curves before are those of the fitted declared model."""
        return replace(self.after, before=self.before.simulations)

    @property
    def search_seconds(self) -> float:
        """Duration in seconds, up to the end of the last fit."""
        return self.after.seconds

    @property
    @override
    def tables(self) -> tuple[str, ...]:
        return ("effects", "findings", "structures", "shapes", *self.after.tables)

    @override
    def table(self, name: str) -> pa.Table:
        if name == "effects":
            return _effect_table(self.effects)
        if name == "findings":
            return _row_table(CandidateEvidence, self.findings)
        if name == "structures":
            return _row_table(ComparedStructure, self.structures)
        if name == "shapes":
            return curve_table(self.curves)
        if name == "parameters":
            return _parameter_table(self.before.estimates, self.after.estimates)
        if name == "errors":
            return _error_table(self.errors, self.before.errors, self.after.errors)
        return self.final.table(name)

    @override
    def facts(self) -> Mapping[str, Any]:
        return fit_facts(self.after) | {
            "status": "done",
            "cost_before": self.before.cost,
            "evaluations": self.evaluations,
            "simulations": self.simulated,
            "failures": self.failures,
            "failures_in_search": self.failures_in_search,
            "seconds": self.seconds,
            "errors_over": self.errors_over.value,
            "verdict": self.verdict.value,
            "summary": self.message,
            "first": self.first,
            "effects": [_effect_facts(effect) for effect in self.effects],
            "likely": likely_sentence(
                self.structures, claims=any(effect.claim is not None for effect in self.effects)
            ),
            "resampled": self.resampled,
            "process_noise": [dataclasses.asdict(each) for each in self.process_noise],
            "competing": [model.facts() for model in self.competing],
            "unexplained": [dataclasses.asdict(each) for each in self.unexplained],
            "rejected": [_effect_facts(effect) for effect in self.rejected],
            "errors": {
                role: {"before": self.rms(role, "before"), "after": self.rms(role, "after")}
                for role in ("train", "test")
            },
            "noise": self.noise,
            "notes": list(self.notes),
            "sites": list(self.sites),
            "left_out": {record: dict(own) for record, own in self.left_out.items()},
        }

    @property
    @override
    def criteria(self) -> InformationCriteria:
        return self.after.criteria

    def __repr__(self) -> str:
        return short_text("LoopResult", str(self.verdict), self.x)


EFFECT_COLUMNS = pa.schema(
    [
        *((name, pa.string()) for name in ("effect", "family", "site", "form")),
        ("variables", pa.list_(pa.string())),
        *((name, pa.string()) for name in ("equation", "words")),
        ("probability", pa.float64()),
        ("coefficient", pa.string()),
        ("value", pa.float64()),
        ("unit", pa.string()),
        *((name, pa.float64()) for name in ("std_error", "lower95", "upper95")),
        ("fixed", pa.bool_()),
    ]
)
KEPT_OF_BEFORE = ("value", "std_error", "lower95", "upper95")


def _parameter_table(before: Sequence[Estimate], after: Sequence[Estimate]) -> pa.Table:
    """Make a row for each final estimate, with the estimate before (NaN if it is new)."""
    old = {e.label: e for e in before}
    rows = []
    for estimate in after:
        then = old.get(estimate.label)
        added = {f"{k}_before": getattr(then, k) if then else np.nan for k in KEPT_OF_BEFORE}
        rows.append(dataclasses.asdict(estimate) | added)
    return pa.Table.from_pylist(rows)


def _error_table(
    changes: Sequence[ErrorChange], before: Sequence[OutputError], after: Sequence[OutputError]
) -> pa.Table:
    """Make a row for each output of each experiment: declared model fitted, and with effects."""
    rows = []
    for change, old, new in zip(changes, before, after, strict=True):
        row = dataclasses.asdict(change)
        row |= {"relative_before": old.relative_after, "relative_after": new.relative_after}
        rows.append(row)
    return pa.Table.from_pylist(rows)


def _effect_table(effects: Sequence[NamedEffect]) -> pa.Table:
    """Make a row for each coefficient of each effect that was added."""
    rows = [
        {
            "effect": effect.name,
            "coefficient": effect.coefficient(estimate),
            "probability": np.nan if effect.claim is None else effect.claim.probability,
            **_named(effect),
            **_numbers(estimate),
        }
        for effect in effects
        for estimate in effect.coefficients
    ]
    return pa.Table.from_pylist(rows, schema=EFFECT_COLUMNS)


ARROW_TYPES = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}


def _row_table(row: type, rows: Sequence[CandidateEvidence | ComparedStructure]) -> pa.Table:
    """Make a table with a column for each field of a row type, even if there are no rows."""
    hints = get_type_hints(row)
    schema = pa.schema([(f.name, _column(hints[f.name])) for f in dataclasses.fields(row)])
    return pa.Table.from_pylist([vars(each) for each in rows], schema=schema)


def _column(kind: Any) -> pa.DataType:
    if get_origin(kind) is tuple:
        return pa.list_(_column(get_args(kind)[0]))
    return next(column for known, column in ARROW_TYPES.items() if issubclass(kind, known))


def _effect_facts(effect: NamedEffect) -> dict[str, Any]:
    """Return one effect with its alternatives and a block for a config."""
    return {
        "name": effect.name,
        **_named(effect),
        "sentence": effect.sentence,
        "claimed": effect.claimed,
        "claim": None if effect.claim is None else dataclasses.asdict(effect.claim),
        "also": [dataclasses.asdict(a) for a in effect.also],
        "period": effect.period,
        "parameters": {effect.coefficient(e): _numbers(e) for e in effect.coefficients},
        "alternatives": [dataclasses.asdict(a) for a in effect.alternatives],
        "evidence": list(effect.evidence),
        "config": config_block(effect),
    }


def _named(effect: NamedEffect) -> dict[str, Any]:
    known = {k: getattr(effect, k) for k in ("family", "site", "form", "equation", "words")}
    return known | {"variables": list(effect.variables)}


def _numbers(estimate: Estimate) -> dict[str, Any]:
    kept = {k: getattr(estimate, k) for k in ("value", "unit", "std_error", "lower95", "upper95")}
    held = {"fixed": estimate.estimated_on == "known", "at_bound": estimate.at_bound}
    return kept | held
