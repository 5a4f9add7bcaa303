"""What a closed loop gives back."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from cluster_est.closed_loop.screening.evidence import CandidateEvidence
from cluster_est.problem import display
from cluster_est.results import actions
from cluster_est.results.display_tables import fit_tables
from cluster_est.results.result import Result
from cluster_est.results.row_types import Estimate
from workers.messages import Effect, FloatArray, Role

if TYPE_CHECKING:  # it needs SymPy, which is slow
    from cluster_est.closed_loop.findings.effect_curves import DrawnEffect
    from cluster_est.export.write import ExportResult


class Verdict(enum.StrEnum):
    """What is said in the end. A member's text is what run.json carries."""

    NONE = "none"
    COLOURED = "none (coloured noise)"
    FOUND = "found"
    PARTIAL = "partial"
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True)
class AlternativeEffect:
    """An effect that cannot be told apart from the one chosen on this data.

    Attributes
    ----------
    site, form, family, variables, equation
        What it is.
    criterion
        By how much its information criterion is worse (negative: better).
    experiment, output, time
        Where its predictions differ most from those of the chosen effect.
    difference
        By how much there, in standard deviations of the noise.
    """

    site: str
    form: str
    family: str
    variables: tuple[str, ...]
    equation: str
    criterion: float
    experiment: str = ""
    output: str = ""
    time: float = np.nan
    difference: float = np.nan


@dataclass(frozen=True)
class NamedEffect:
    """An effect that was added to the model.

    Attributes
    ----------
    effect
        As it can be written into a config.
    family, equation
        "friction", "der(v) += -k * tanh(v / width)".
    coefficients
        Its estimated numbers, with intervals and units.
    alternatives
        What it cannot be told apart from.
    evidence
        Sentences.
    """

    effect: Effect
    family: str
    equation: str
    coefficients: tuple[Estimate, ...]
    alternatives: tuple[AlternativeEffect, ...] = ()
    evidence: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def site(self) -> str:
        return self.effect.site

    @property
    def form(self) -> str:
        return self.effect.form

    @property
    def variables(self) -> tuple[str, ...]:
        return self.effect.variables


@dataclass(frozen=True)
class ErrorChange:
    """How well an output of an experiment is followed, before and after.

    `rmse` is in the output's unit, `normalised` over sigma (the given one, else the estimated
    noise).
    """

    experiment: str
    role: Role
    output: str
    unit: str
    samples: int
    rmse_before: float
    rmse_after: float
    normalised_before: float
    normalised_after: float


@dataclass(frozen=True)
class LoopResult:
    """The result of a closed loop.

    Attributes
    ----------
    verdict, summary
        What was found, in a word and in a paragraph.
    effects
        What was added; empty unless the verdict is "found" or "partial".
    before, after
        Fits of the declared model, and with the effects; the same where nothing was added.
    errors
        For each output of each experiment.
    findings
        Every candidate of every step.
    rejected
        Effects that the search ended with but that did not pass; a picture of where to look.
    noise
        Estimated standard deviation of each output's noise, in the output's unit.
    sites
        Every site that was open.
    notes
        What a reader should know: closed sites, no held-out experiment, sigma at odds with noise.
    drawn
        The shapes of the effects that were added.
    simulations
        In units of one experiment's full length.
    simulated, evaluations, failures, seconds
        What it took.
    """

    verdict: Verdict
    summary: str
    effects: tuple[NamedEffect, ...]
    before: Result = field(repr=False)
    after: Result = field(repr=False)
    errors: tuple[ErrorChange, ...]
    findings: tuple[CandidateEvidence, ...] = field(repr=False)
    rejected: tuple[NamedEffect, ...]
    noise: dict[str, float]
    sites: tuple[str, ...]
    notes: tuple[str, ...]
    simulations: float
    simulated: int
    evaluations: int
    failures: int
    seconds: float
    drawn: tuple[DrawnEffect, ...] = field(default=(), repr=False)

    def rms(self, role: Role, when: str) -> float:
        """Root mean square of the normalised errors "before" or "after"; NaN without any."""
        rows = [e for e in self.errors if e.role == role]
        if not rows:
            return np.nan
        samples = np.array([e.samples for e in rows], np.float64)
        values = np.array([getattr(e, f"normalised_{when}") for e in rows])
        return float(np.sqrt((samples * values**2).sum() / samples.sum()))

    @property
    def success(self) -> bool:
        """Whether the last fit reached a solution; what was found is said by `verdict`."""
        return self.after.success

    @property
    def message(self) -> str:
        """The summary."""
        return self.summary

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
    def tables(self) -> tuple[str, ...]:
        """What `table` can give: a run folder's files have the same names."""
        return tuple(dict.fromkeys(("effects", "findings", "shapes", *self.after.tables)))

    def table(self, name: str) -> pa.Table:
        """One of `tables`, with the columns that it has in a run folder.

        Raises
        ------
        RunFolderError
            If there is no such table.
        """
        from cluster_est.closed_loop.findings import tables  # it knows this class

        made = {
            "effects": tables.effect_table,
            "findings": tables.finding_table,
            "shapes": tables.shape_table,
            "parameters": tables.parameter_table,
            "errors": tables.error_table,
        }
        return made[name](self) if name in made else self.final.table(name)

    @property
    def parameters(self) -> pa.Table:
        """The table of that name: with the effects, and before."""
        return self.table("parameters")

    @property
    def residuals(self) -> pa.Table:
        """The table of that name, with the effects."""
        return self.final.residuals

    @property
    def trajectories(self) -> pa.Table:
        """The table of that name, with the effects."""
        return self.final.trajectories

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write a run folder; see `Result.save`."""
        return actions.save(self, folder, overwrite=overwrite)

    def report(self, path: str | Path) -> Path:
        """Write the report: one HTML file; see `Result.report`."""
        return actions.report(self, path)

    def export(
        self,
        fmu: str | Path | None = None,
        ssv: str | Path | None = None,
        *,
        modelica: bool = False,
        text: bool = False,
        experiment: str | None = None,
    ) -> ExportResult:
        """Write the model with its effects; see `Result.export`."""
        return actions.export(self, fmu, ssv, modelica=modelica, text=text, experiment=experiment)

    def __str__(self) -> str:
        """What `print` shows."""
        return display.plain(self._title, *self._tables)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return display.section(self._title, *self._tables)

    @property
    def _title(self) -> str:
        return f"Closed loop: {self.verdict}. {self.summary}"

    @property
    def _tables(self) -> tuple[display.DisplayTable, ...]:
        effects = [(e.name, e.family, e.equation) for e in self.effects]
        return (
            display.DisplayTable("Effects", ("name", "family", "equation"), effects),
            *fit_tables(self.after.estimates, self.errors),
        )
