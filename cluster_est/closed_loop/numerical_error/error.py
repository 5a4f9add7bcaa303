"""The numerical error of a fitted model beside the noise of its data, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.thresholds import NumericalErrorThresholds
from cluster_est.results.solver_error.finer_solver import SolverScale
from workers.messages import FloatArray

LEAST_ORDER, MOST_ORDER = 1.0, 4.0
"""Between which the order of a step is believed: events and kinks spoil what is observed."""


@dataclass(frozen=True)
class NumericalError:
    """The error of solver and steps at a fit, measured by a finer solver.

    Attributes
    ----------
    scale
        What decides how exact the solver is.
    outputs
        Names.
    rms, noise, residual : (outputs,)
        Root mean squares of each output's numerical error, noise and residual, in units of its
        residual.
    squares
        Of the numerical error, summed over all residuals.
    order
        Of the step, as observed or assumed; NaN where a tolerance decides.
    why_not
        Part of a sentence: why it could not be measured; the arrays are empty then.
    beside
        Other sentences on the solver.
    thresholds
        What counts as small, large and loose.
    """

    scale: SolverScale
    outputs: tuple[str, ...] = ()
    rms: FloatArray = field(default_factory=lambda: np.zeros(0))
    noise: FloatArray = field(default_factory=lambda: np.zeros(0))
    residual: FloatArray = field(default_factory=lambda: np.zeros(0))
    squares: float = 0.0
    order: float = np.nan
    why_not: str = ""
    beside: tuple[str, ...] = ()
    thresholds: NumericalErrorThresholds = field(default_factory=NumericalErrorThresholds)

    @property
    def ratios(self) -> FloatArray:
        """(outputs,): over the noise; 0 where nothing is left that could be explained."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = self.rms / self.noise
        return np.where((self.rms > 0.0) & (self.residual > 0.0), ratios, 0.0)

    @property
    def ratio(self) -> float:
        """The largest of them."""
        return float(np.nanmax(self.ratios, initial=0.0))

    @property
    def explainable(self) -> float:
        """Fall of the sum of squares that an effect could owe to the numerical error."""
        return self.thresholds.known**2 * self.squares

    @property
    def hides_effects(self) -> bool:
        """Whether no effect can be told from it: large against the noise, and much of what is left.

        Where the residual is far larger than both, most of it is something else.
        """
        large = self.ratios > self.thresholds.large
        return bool(np.any(large & (self.rms > self.thresholds.share * self.residual)))

    @property
    def refusal(self) -> str:
        """Return why no effect is looked for, in a sentence."""
        return (
            f"{self._said}, so no missing effect can be distinguished from it: set "
            f"{self._advice} first, and run this again"
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the reader; none where the error is small and was to be expected."""
        if self.why_not:
            cannot = (
                f"the numerical error of {self.scale.name} could not be measured: {self.why_not}; "
                "what was found may be due to it"
            )
            return (*self.beside, cannot)
        if self.hides_effects:
            why = f"no effect was looked for, because {self._said}"
            return (*self.beside, f"{why}; {self._advice} makes it negligible")
        if self.ratio > self.thresholds.small:
            said = f"{self._said}; an effect that explains no more than it could is refused"
            return (*self.beside, f"{said}; {self._advice} makes it negligible")
        if self.scale.rtol > self.thresholds.loose:
            said = f"{self._said}, which is negligible here"
            return (*self.beside, f"{said}; {self._advice} keeps it so elsewhere")
        return self.beside

    @property
    def notes_with_effects(self) -> tuple[str, ...]:
        """Sentences on the error of a model with effects; none where it is small."""
        if not self.ratio > self.thresholds.small:
            return ()
        refused = "a further effect that explains no more than it could is refused"
        return (f"with the effects, {self._said}; {refused}; {self._advice} makes it negligible",)

    @property
    def _said(self) -> str:
        largest = int(np.nanargmax(self.ratios))
        output = self.outputs[largest]
        figure = f"{self.ratio:.2g}" if self.ratio < 100.0 else f"{self.ratio:.0f}"
        size = f"{figure} times the noise"
        if not np.isfinite(self.ratio):  # there is none
            size = f"{self.rms[largest] / self.residual[largest]:.2g} times all that is left"
        how = "" if np.isnan(self.order) else f", of order {self.order:.2g} in the step"
        return f"{self.scale.name} has an error of {size} (at {output}{how})"

    @property
    def _advice(self) -> str:
        factor = self.ratio / self.thresholds.small
        factor = factor if np.isfinite(factor) else 1.0 / self.thresholds.small
        if not self.scale.step:  # a looser tolerance than is usual is never the advice
            factor = max(factor, self.scale.rtol / self.thresholds.loose)
        return self.scale.advice(factor, self.order)


def observed_order(first: FloatArray, second: FloatArray, ratio: float) -> float:
    """Order of a step, from the differences of three solutions whose steps have one ratio.

    With an error C h^p the differences y(h) - y(h/q) and y(h/q) - y(h/q^2) have the ratio q^p
    (L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357, doi:10.1098/rsta.1911.0009).

    Returns
    -------
    float
        Between 1 and 4; 1 where they do not fall. NaN never.
    """
    sizes = [float(np.sqrt(np.add.reduce(each**2))) for each in (first, second)]
    if not sizes[1] > 0.0:
        return MOST_ORDER
    with np.errstate(divide="ignore"):
        order = np.log(sizes[0] / sizes[1]) / np.log(ratio)
    return float(np.clip(order, LEAST_ORDER, MOST_ORDER))


def extrapolated(difference: FloatArray, ratio: float, order: float) -> FloatArray:
    """Error of the coarser of two solutions, from y(h) - y(h/q) = (1 - q^-p) C h^p."""
    return np.asarray(difference / (1.0 - ratio**-order))
