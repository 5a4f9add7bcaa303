"""The result of a closed loop."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import pyarrow as pa
from typing_extensions import override

from cluster_est.closed_loop.findings import tables
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
)
from cluster_est.closed_loop.findings.remaining_error import comparable, pooled_error
from cluster_est.closed_loop.findings.unexplained import UnexplainedResidual
from cluster_est.closed_loop.screening.evidence import CandidateEvidence
from cluster_est.closed_loop.selection.rounds import ComparedStructure
from cluster_est.problem.problem import Problem
from cluster_est.results.criteria import InformationCriteria
from cluster_est.results.facts import fit_facts
from cluster_est.results.fit_tables import EffectCurve
from cluster_est.results.result import Result
from cluster_est.results.shapes.effect_table import curve_table
from cluster_est.results.view import ResultView, short_text
from workers.messages import FloatArray, Role
from workers.messages.types import by_content


class ErrorScale(enum.StrEnum):
    """The divisor of normalised errors. A member's text is what run.json carries."""

    SIGMA = "sigma"
    ESTIMATED_NOISE = "estimated noise"
    PREDICTED = "predicted spread"


@by_content
@dataclass(frozen=True, repr=False)
class LoopResult(ResultView):
    """The result of a closed loop.

    Attributes
    ----------
    verdict, message
        In a word and in a paragraph.
    effects
        Those that were added; empty unless the verdict is "found" or "partial".
    before, after
        Fits of the declared model, and with the effects; the same where nothing was added.
    errors
        For each output of each experiment.
    findings
        Every candidate of every step.
    rejected
        Effects that the search ended with but that did not pass: a hint at the place to look.
    noise
        Estimated standard deviation of each output's noise, in the output's unit; empty with
        process noise, where it is the given sigma.
    sites
        Every site that was open.
    notes
        For the reader: closed sites, no held-out experiment, sigma at odds with noise.
    simulations
        In units of one experiment's full length.
    simulated, evaluations, failures, seconds
        Its cost.
    curves
        Of the effects that were added.
    errors_over
        The divisor of the normalised errors.
    structures
        Every set of effects that was refitted: the path of the search. If the verdict is "found",
        with the probability of each; `likely` has those that hold 90 %.
    failures_in_search
        How many of the failures came while effects were tried: one that does not fit makes a model
        that cannot be simulated, and is put aside.
    unexplained
        What is left of each output beyond its noise, where the verdict is "partial" or
        "unexplained": its size, and how fast it is. The largest over its noise comes first.
    resampled
        How often the effects are chosen where the training experiments are drawn anew, in a
        sentence; "" where that is not known.
    competing
        What was found and the rivals that the data do not rule out, as they fit: what `design`
        plans an experiment for. Empty where nothing was added, and with process noise.
    process_noise
        Its strength before and after; empty where nothing was added.
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

    def rms(self, role: Role, when: Literal["before", "after"]) -> float:
        """Root mean square of the normalised errors before or after; NaN without any.

        Both are of the experiments that were simulated before and after.
        """
        return pooled_error(comparable(self.errors), role, after=when == "after")

    @property
    def likely(self) -> tuple[ComparedStructure, ...]:
        """The fewest sets of effects that hold 90 % of the probability, and what was added.

        The likeliest first; the declared model may be one of them. Empty unless the verdict is
        "found": what else is missing would change their order.
        """
        return likely_structures(self.structures)

    @property
    def problem(self) -> Problem:
        """With the effects that were added."""
        return self.after.problem

    @property
    def success(self) -> bool:
        """The last fit reached a solution; `verdict` says what was found."""
        return self.after.success

    @property
    def x(self) -> dict[str, float]:
        """Physical values by label, those of the effects' coefficients among them."""
        return self.after.x

    @property
    def cost(self) -> float:
        """Of the training experiments, with the effects."""
        return self.after.cost

    @property
    def fun(self) -> FloatArray | None:
        """Residuals of the training experiments, with the effects; see `Result.fun`."""
        return self.after.fun

    @property
    def jac(self) -> FloatArray | None:
        """Of the last fit, with the effects; see `Result.jac`."""
        return self.after.jac

    @property
    def nfev(self) -> int:
        """Points that were asked for."""
        return self.evaluations

    @property
    def nit(self) -> int:
        """Iterations of the last fit."""
        return self.after.nit

    @property
    def final(self) -> Result:
        """The fit with the effects, beside the curves of the declared model fitted."""
        return replace(self.after, before=self.before.simulations)

    @property
    def search_seconds(self) -> float:
        """Seconds until the last fit had ended."""
        return self.after.seconds

    @property
    @override
    def tables(self) -> tuple[str, ...]:
        return ("effects", "findings", "structures", "shapes", *self.after.tables)

    @override
    def table(self, name: str) -> pa.Table:
        if name == "effects":
            return tables.effect_table(self.effects)
        if name == "findings":
            return tables.finding_table(self.findings)
        if name == "structures":
            return tables.structure_table(self.structures)
        if name == "shapes":
            return curve_table(self.curves)
        if name == "parameters":
            return tables.parameter_table(self.before.estimates, self.after.estimates)
        if name == "errors":
            return tables.error_table(self.errors, self.before.errors, self.after.errors)
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
            "effects": [tables.effect_facts(effect) for effect in self.effects],
            "likely": likely_sentence(self.structures),
            "resampled": self.resampled,
            "process_noise": [dataclasses.asdict(each) for each in self.process_noise],
            "competing": [model.facts() for model in self.competing],
            "unexplained": [dataclasses.asdict(each) for each in self.unexplained],
            "rejected": [tables.effect_facts(effect) for effect in self.rejected],
            "errors": {
                role: {"before": self.rms(role, "before"), "after": self.rms(role, "after")}
                for role in ("train", "test")
            },
            "errors_by_output": tables.errors_by_output(self.errors),
            "noise": self.noise,
            "notes": list(self.notes),
            "sites": list(self.sites),
            "experiments_simulated": self.simulations,
        }

    @property
    @override
    def criteria(self) -> InformationCriteria:
        return self.after.criteria

    def __repr__(self) -> str:
        return short_text("LoopResult", str(self.verdict), self.x)
