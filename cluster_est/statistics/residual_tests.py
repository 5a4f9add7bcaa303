"""Tests of a fit's residuals, output by output, and what follows from them."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from cluster_est.statistics.autocorrelation import autocorrelation
from cluster_est.statistics.noise import estimate_noise
from cluster_est.statistics.records import OutputRecord, StackedRecords
from cluster_est.statistics.whiteness import WhiteNull, smoothness
from workers.messages import FloatArray

LEVEL = 1e-3
"""Of all tests of a fit together: of a hundred fits in which nothing is wrong none warns."""

LEAST_DEGREES = 20
"""Degrees of freedom that an output needs, or its p-values are too rough."""

LARGE, SMALL = 1.2, 0.5
"""An rms over sigma above or below these is worth a word: a sigma is rarely known any better."""

NOISY = 2.0
"""Noise over sigma from which on the declared sigma itself is doubted."""

OUTLYING = 1.5
"""Size of white residuals over the noise of most of them from which on a few must lie far off."""

LEAST_NOISE = 1e-3
"""Noise over rms below which the estimate is not believed."""


class ResidualStructure(enum.StrEnum):
    """What the residuals look like."""

    NOT_TESTED = "not tested"
    WHITE = "white"
    AUTOCORRELATED = "autocorrelated"
    MISSING = "something is missing"


class SigmaDoubt(enum.StrEnum):
    """What the residuals say of the declared sigma."""

    NONE = ""
    TOO_SMALL = "sigma too small"
    TOO_LARGE = "sigma too large"
    OUTLIERS = "outliers"


@dataclass(frozen=True)
class OutputDiagnostics:
    """The training residuals of one output, of all records together.

    Attributes
    ----------
    output
        The FMU's name; "all outputs together" where they are pooled.
    samples
        In all training experiments.
    declared
        Whether it has a sigma that its residuals can be compared with.
    rms_over_sigma
        With the degrees of freedom that the parameters have left; over the unit of the output
        where no sigma is declared.
    noise_over_sigma
        The noise from sample to sample, see `estimate_noise`, likewise.
    lag1, widening
        See `Autocorrelation`.
    p, length
        Probability that white noise looks so smooth, times the number of tests of the fit; and
        over how many samples.
    structure, sigma
        What follows.
    """

    output: str
    samples: int
    declared: bool
    rms_over_sigma: float
    noise_over_sigma: float
    lag1: float
    widening: float
    p: float
    length: float
    structure: ResidualStructure
    sigma: SigmaDoubt

    @property
    def rms_over_noise(self) -> float:
        return self.rms_over_sigma / self.noise_over_sigma if self.noise_over_sigma else np.nan


@dataclass(frozen=True)
class ResidualDiagnostics:
    """The training residuals of a fit.

    Attributes
    ----------
    outputs
        One for each output.
    together
        All outputs pooled, each over its noise; None where there is only one.
    converged
        Whether the search reached a solution: else that alone may leave structure.
    """

    outputs: tuple[OutputDiagnostics, ...]
    together: OutputDiagnostics | None = None
    converged: bool = True

    @property
    def findings(self) -> tuple[OutputDiagnostics, ...]:
        """Those to be warned of: each output, or all together where no single one stands out."""
        found = tuple(o for o in self.outputs if _structured(o) or o.sigma)
        if any(map(_structured, found)) or self.together is None or not _structured(self.together):
            return found
        return (*found, self.together)

    @property
    def too_narrow(self) -> bool:
        """True where the intervals promise more than the residuals allow."""
        return any(map(_structured, self.findings))


def _structured(output: OutputDiagnostics) -> bool:
    return output.structure in (ResidualStructure.AUTOCORRELATED, ResidualStructure.MISSING)


@dataclass(frozen=True)
class ResidualTests:
    """The tests of the residuals of a fit.

    Attributes
    ----------
    residuals : (n,)
        Stacked, over sigma.
    records
        Their rows.
    basis : (n, rank)
        Orthonormal directions that the fit has taken out; none of them where they are not known.
    declared
        Whether each output has a sigma that its residuals can be compared with.
    exact
        Whether each output is followed so closely that there is nothing to test.
    """

    residuals: FloatArray = field(repr=False)
    records: StackedRecords
    basis: FloatArray = field(repr=False)
    declared: tuple[bool, ...]
    exact: tuple[bool, ...]

    def run(self) -> tuple[tuple[OutputDiagnostics, ...], OutputDiagnostics | None]:
        """Test each output, and all together.

        Structure is looked for by `smoothness`. The size of a mean square is judged by a
        chi-squared distribution with the degrees of freedom that the parameters left, divided by
        what autocorrelation takes away (`Autocorrelation.squares`). `LEVEL` is shared by all tests
        (Bonferroni).

        Returns
        -------
        outputs
            One for each output.
        together
            None where there are no two outputs to test.
        """
        records = self.records
        names = records.outputs
        rms = np.array([_rms(self.residuals[records.of_output(o)]) for o in range(len(names))])
        noise = estimate_noise(self.residuals, records)
        noise = np.where(noise > LEAST_NOISE * rms, noise, rms)
        usable = [o for o in range(len(names)) if rms[o] > 0.0 and not self.exact[o]]
        count = len(usable) + (len(usable) > 1)
        of_rows = np.ones(len(self.residuals))
        for o in usable:
            of_rows[records.of_output(o)] = noise[o]
        null = WhiteNull.of(self.basis, of_rows)
        scaled = self.residuals / of_rows
        found = []
        for o in range(len(names)):
            items = [item for item in records.items if item.output == o]
            scope = _Scope(names[o], items, self.declared[o], float(noise[o]))
            found.append(self._of(scope, scaled, null, count if o in usable else 0))
        if len(usable) < 2:
            return tuple(found), None
        items = [item for item in records.items if item.output in usable]
        declared = all(self.declared[o] for o in usable)
        rows = np.concatenate([records.of_output(o) for o in usable])
        scope = _Scope("all outputs together", items, declared, _rms(of_rows[rows]))
        return tuple(found), self._of(scope, scaled, null, count)

    def _of(
        self, scope: _Scope, scaled: FloatArray, null: WhiteNull, count: int
    ) -> OutputDiagnostics:
        """Test some records, of a fit with `count` tests; with 0 only say what they are."""
        rows = np.concatenate([np.arange(i.rows.start, i.rows.stop) for i in scope.items])
        own = self.residuals[rows]
        degrees = len(rows) - float(np.add.reduce(self.basis[rows].ravel() ** 2))
        related = autocorrelation(scaled, scope.items)
        square = float(np.add.reduce(own**2))
        size = _Size(square, degrees, related.squares, LEVEL / max(count, 1))
        tested = count > 0 and degrees >= LEAST_DEGREES
        found = smoothness(scaled, scope.items, null) if tested else None
        p = np.nan if found is None else min(1.0, count * found.p)
        structure, doubt = ResidualStructure.NOT_TESTED, SigmaDoubt.NONE
        if tested:
            structure, doubt = _judged(p, size, scope.noise, declared=scope.declared)
        return OutputDiagnostics(
            output=scope.name,
            samples=len(rows),
            declared=scope.declared,
            rms_over_sigma=size.rms,
            noise_over_sigma=scope.noise,
            lag1=related.lag1,
            widening=related.widening,
            p=p,
            length=np.nan if found is None else found.length,
            structure=structure,
            sigma=doubt,
        )


@dataclass(frozen=True)
class _Scope:
    """Records that are judged together, and the size of their noise over sigma."""

    name: str
    items: Sequence[OutputRecord]
    declared: bool
    noise: float


@dataclass(frozen=True)
class _Size:
    """A sum of squares over sigma^2, its degrees of freedom, and what correlation makes of them."""

    square: float
    degrees: float
    correlation: float
    level: float

    @property
    def rms(self) -> float:
        return float(np.sqrt(self.square / max(self.degrees, 1.0)))

    @property
    def large(self) -> bool:
        """Whether it is above sigma by more than chance and carelessness."""
        p = chi2.sf(self.square / self.correlation, self.degrees / self.correlation)
        return self.rms > LARGE and bool(p < self.level)

    @property
    def small(self) -> bool:
        """Whether it is below."""
        p = chi2.cdf(self.square / self.correlation, self.degrees / self.correlation)
        return self.rms < SMALL and bool(p < self.level)


def _judged(
    p: float, size: _Size, noise: float, *, declared: bool
) -> tuple[ResidualStructure, SigmaDoubt]:
    """Say what a p-value of smoothness, and the sizes of residuals and noise over sigma, mean."""
    related = p < LEVEL
    structure = ResidualStructure.AUTOCORRELATED if related else ResidualStructure.WHITE
    if not declared:
        return structure, SigmaDoubt.NONE
    if size.small:
        return structure, SigmaDoubt.TOO_LARGE
    if related:
        if noise > NOISY and size.rms < NOISY * noise:
            return structure, SigmaDoubt.TOO_SMALL
        return (ResidualStructure.MISSING if size.large else structure), SigmaDoubt.NONE
    if not size.large:
        return structure, SigmaDoubt.NONE
    few = size.rms > OUTLYING * noise
    return structure, SigmaDoubt.OUTLIERS if few else SigmaDoubt.TOO_SMALL


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
