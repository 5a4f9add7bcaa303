"""Tests of a fit's residuals for each output, and their conclusions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtr, chdtrc, ndtr

from cluster_est.statistics.noise.estimate import estimate_noise
from cluster_est.statistics.projection import NOTHING_LEFT, ProjectedResidual
from cluster_est.statistics.records import OutputRecord, StackedRecords
from cluster_est.statistics.residual_findings import (
    OutputDiagnostics,
    ResidualStructure,
    SigmaDoubt,
)
from cluster_est.statistics.whiteness import (
    WHITENESS_LENGTHS,
    SmoothnessTest,
    WhiteNull,
    smoothness,
)
from workers.messages import FloatArray

WINDOW = 5.0
"""Number of summed lags, over the correlation time of their sum; later lags are only noise."""


@dataclass(frozen=True)
class Autocorrelation:
    """The autocorrelation of residuals, and its influence on standard errors and mean squares.

    Attributes
    ----------
    lag1
        Correlation of neighbouring samples; 0 if there are no neighbours.
    widening
        Square root of 1 + 2 (rho_1 + rho_2 + ...), at least 1. Standard errors that assume white
        residuals are too small by about this factor if the sensitivities vary more slowly than the
        noise.
    squares
        1 + 2 (rho_1^2 + rho_2^2 + ...): the factor by which a mean square has fewer samples.
    lags
        Number of lags in these sums.
    """

    lag1: float
    widening: float
    squares: float
    lags: int = 0


def lagged_products(parts: Sequence[FloatArray]) -> FloatArray:
    """Return the sums of r_t r_{t+k} for lags k = 0, 1, ...; no product spans two parts."""
    sums = np.zeros(max(map(len, parts), default=0))
    for part in parts:
        padded = next_fast_len(2 * len(part), real=True)
        spectrum = rfft(part, padded)
        power = spectrum.real**2 + spectrum.imag**2
        sums[: len(part)] += irfft(power, padded)[: len(part)]
    return sums


def autocorrelation(residuals: FloatArray, records: Sequence[OutputRecord]) -> Autocorrelation:
    """Return the autocorrelation rho_k = sum r_t r_{t+k} / sum r_t^2 of pooled records.

    No product spans two records. The sums over lags end at the first lag that is at least 5 times
    the correlation time of the lags so far (A. Sokal in Functional Integration (1997) 131-192,
    doi:10.1007/978-1-4899-0319-8_6, section 3). For the effective numbers of samples of a mean and
    of a mean square, see G. V. Bayley, J. M. Hammersley, Suppl. J. R. Stat. Soc. 8 (1946) 184-197,
    doi:10.2307/2983560.

    Parameters
    ----------
    residuals : (n,)
        Residuals of all records; their scale is irrelevant.
    records
        The records to pool.
    """
    covariances = lagged_products([residuals[r.rows] for r in records if len(r.times)])
    if len(covariances) < 2 or covariances[0] <= 0.0:
        return Autocorrelation(0.0, 1.0, 1.0)
    rho = covariances[1:] / covariances[0]
    times = 0.5 + np.cumsum(rho)
    enough = np.flatnonzero(np.arange(1, len(rho) + 1) >= WINDOW * times)
    end = int(enough[0]) + 1 if len(enough) else len(rho)
    widening = float(np.sqrt(max(1.0, 2.0 * times[end - 1])))
    return Autocorrelation(
        float(rho[0]), widening, 1.0 + 2.0 * float(np.add.reduce(rho[:end] ** 2)), end
    )


FAMILY_WISE_LEVEL = 2e-3
"""Family-wise level of all tests of structure in a fit, and of all tests of size. So fewer than 1
of 100 fits has a false warning. In 1500 linear fits to white noise, with one or two outputs and 60
to 300 samples per record, 0.3 % of the fits were below it (standard error 0.15 %)."""

MOST_TRANSFORMED_ENTRIES = 1_000_000
"""Largest number of entries of a Jacobian that the test uses; its transforms take about a second.
Without the Jacobian, the test ignores that a fit removes smooth parts of noise, so it is slightly
less sensitive."""

LEAST_DEGREES = 20
"""Least degrees of freedom of a tested output; with fewer, p-values are too inaccurate."""

LARGE_RMS_OVER_SIGMA, SMALL_RMS_OVER_SIGMA = 1.2, 0.5
"""Ratios of rms to sigma above and below which sigma is doubted; a sigma is rarely known better."""

NOISY = 2.0
"""Ratio of noise to sigma above which the declared sigma itself is doubted."""

LEAST_NOISE_OVER_RMS = 1e-3
"""Ratio of noise to rms below which the noise estimate is not used."""

ALL_OUTPUTS_TOGETHER = "all outputs together"


def structure(tested: ProjectedResidual, records: StackedRecords) -> SmoothnessTest:
    """Test a residual for smooth structure: each output, and all outputs together.

    The test needs no candidates, so it also detects structure that no form of the library explains.
    If a candidate explains it, `score.family_wise` detects smaller effects. Coloured noise is also
    smooth structure.

    Parameters
    ----------
    tested
        The residual; its scale is irrelevant.
    records
        The rows of each output and experiment.

    Returns
    -------
    SmoothnessTest
        The smallest p-value of `ResidualTests`, times their number; 1 if nothing can be tested.
    """
    basis = tested.projection.basis
    left = tested.projection.remove(tested.residuals)
    if basis.size > MOST_TRANSFORMED_ENTRIES:
        basis = basis[:, :0]
    none = (False,) * len(records.outputs)
    found = [SmoothnessTest(1.0, WHITENESS_LENGTHS[0])]
    if np.linalg.norm(left) > NOTHING_LEFT * np.linalg.norm(tested.residuals):
        outputs, together = ResidualTests(left, records, basis, none, none).run()
        every = outputs if together is None else (*outputs, together)
        found += [SmoothnessTest(each.p, each.length) for each in every if np.isfinite(each.p)]
    return min(found, key=lambda each: each.p)


@dataclass(frozen=True)
class ResidualTests:
    """The tests of the residuals of a fit.

    Attributes
    ----------
    residuals : (n,)
        Residuals of all records, over sigma.
    records
        The rows of each output and experiment.
    basis : (n, rank)
        Orthonormal directions that the fit has removed; rank 0 if they are not known.
    declared
        Whether each output has a declared sigma.
    exact
        Whether each output is fitted so closely that there is nothing to test.
    """

    residuals: FloatArray = field(repr=False)
    records: StackedRecords
    basis: FloatArray = field(repr=False)
    declared: tuple[bool, ...]
    exact: tuple[bool, ...]

    def run(self) -> tuple[tuple[OutputDiagnostics, ...], OutputDiagnostics | None]:
        """Test each output, and all outputs together.

        `smoothness` tests for structure. The size of a mean square is compared with a chi-squared
        distribution. Its degrees of freedom are those that the fit leaves, divided by the factor
        for autocorrelation (`Autocorrelation.squares`). All tests share `FAMILY_WISE_LEVEL`
        (Bonferroni).

        Returns
        -------
        outputs
            One for each output.
        together
            None if there are fewer than two outputs to test.
        """
        noise = self._noise()
        scopes = self._scopes(noise)
        tested = [scope for scope in scopes if scope.degrees >= LEAST_DEGREES and not scope.exact]
        of_rows = np.empty(len(self.residuals))
        for output, level in enumerate(noise):
            of_rows[self.records.of_output(output)] = level
        scaled = self.residuals / of_rows
        null = WhiteNull(self.basis, of_rows)
        tests = smoothness(scaled, [scope.items for scope in tested], null)
        results = {scope.name: test for scope, test in zip(tested, tests, strict=True)}
        found = [self._of(scope, scaled, results) for scope in scopes]
        outputs = tuple(found[: len(noise)])
        return outputs, found[-1] if len(found) > len(outputs) else None

    def _noise(self) -> FloatArray:
        """Return the noise of each output over sigma; it is never 0."""
        names = range(len(self.records.outputs))
        rms = np.array([_rms(self.residuals[self.records.of_output(o)]) for o in names])
        noise = estimate_noise(self.residuals, self.records)
        noise = np.where(noise > LEAST_NOISE_OVER_RMS * rms, noise, rms)
        return np.where(noise > 0.0, noise, np.min(noise[noise > 0.0], initial=1.0))

    def _scopes(self, noise: FloatArray) -> list[_Scope]:
        """Return each output, and all outputs together if at least two can be tested."""
        scopes = []
        for o, name in enumerate(self.records.outputs):
            items = [item for item in self.records.items if item.output == o]
            level = float(noise[o])
            scopes.append(self._scope(name, items, level, self.declared[o], self.exact[o]))
        usable = [o for o, scope in enumerate(scopes) if not scope.exact]
        if len(usable) > 1:
            items = [item for item in self.records.items if item.output in usable]
            counts = [len(self.records.of_output(o)) for o in usable]
            level = float(np.sqrt(np.average(noise[usable] ** 2, weights=counts)))
            declared = all(self.declared[o] for o in usable)
            scopes.append(self._scope(ALL_OUTPUTS_TOGETHER, items, level, declared, exact=False))
        return scopes

    def _scope(
        self, name: str, items: list[OutputRecord], noise: float, declared: bool, exact: bool
    ) -> _Scope:
        rows = np.concatenate([np.arange(i.rows.start, i.rows.stop) for i in items])
        square = float(np.add.reduce(self.residuals[rows] ** 2))
        largest = float(np.max(np.abs(self.residuals[rows]), initial=0.0))
        degrees = len(rows) - float(np.add.reduce(self.basis[rows].ravel() ** 2))
        exact = exact or square == 0.0
        return _Scope(name, items, declared, exact, noise, len(rows), square, degrees, largest)

    def _of(
        self, scope: _Scope, scaled: FloatArray, results: Mapping[str, SmoothnessTest]
    ) -> OutputDiagnostics:
        """Return the findings of a scope; without a test, there are no conclusions."""
        related = autocorrelation(scaled, scope.items)
        size = _Size(
            square=scope.square,
            degrees=scope.degrees,
            correlation=related.squares,
            largest=scope.largest,
            level=FAMILY_WISE_LEVEL / max(len(results), 1),
        )
        structure, doubt = ResidualStructure.NOT_TESTED, SigmaDoubt.NONE
        p = length = np.nan
        if scope.name in results:
            test = results[scope.name]
            p, length = min(1.0, len(results) * test.p), test.length
            structure, doubt = _judged(p, size, scope.noise, declared=scope.declared)
        return OutputDiagnostics(
            output=scope.name,
            samples=scope.samples,
            declared=scope.declared,
            rms_over_sigma=size.rms,
            noise_over_sigma=scope.noise,
            largest_over_rms=size.largest / size.rms if size.rms else np.nan,
            lag1=related.lag1,
            widening=related.widening,
            p=p,
            length=length,
            structure=structure,
            sigma=doubt,
        )


@dataclass(frozen=True)
class _Scope:
    """Records that are tested together, and their sum of squares over sigma squared."""

    name: str
    items: Sequence[OutputRecord]
    declared: bool
    exact: bool
    noise: float
    samples: int
    square: float
    degrees: float
    largest: float


@dataclass(frozen=True)
class _Size:
    """A sum of squares over sigma^2, its degrees of freedom, and the factor of correlation."""

    square: float
    degrees: float
    correlation: float
    largest: float
    level: float

    @property
    def rms(self) -> float:
        return float(np.sqrt(self.square / max(self.degrees, 1.0)))

    @property
    def large(self) -> bool:
        """Whether the rms exceeds sigma by more than chance and the usual uncertainty of sigma."""
        p = chdtrc(self.degrees / self.correlation, self.square / self.correlation)
        return self.rms > LARGE_RMS_OVER_SIGMA and bool(p < self.level)

    @property
    def outlying(self) -> bool:
        """Whether the largest residual is too large for normal noise of this size.

        The test of F. E. Grubbs, Ann. Math. Statist. 21 (1950) 27-58, doi:10.1214/aoms/1177729885,
        with a normal distribution instead of Student's, and Bonferroni's inequality.
        """
        return bool(2.0 * self.degrees * ndtr(-self.largest / self.rms) < self.level)

    @property
    def small(self) -> bool:
        """Whether the rms is clearly below sigma."""
        p = chdtr(self.degrees / self.correlation, self.square / self.correlation)
        return self.rms < SMALL_RMS_OVER_SIGMA and bool(p < self.level)


def _judged(
    p: float, size: _Size, noise: float, *, declared: bool
) -> tuple[ResidualStructure, SigmaDoubt]:
    """Return the conclusions from the p-value of smoothness and the sizes of residual and noise."""
    related = p < FAMILY_WISE_LEVEL
    structure = ResidualStructure.AUTOCORRELATED if related else ResidualStructure.WHITE
    if declared and size.small:
        return structure, SigmaDoubt.TOO_LARGE
    if not related and size.outlying:
        return structure, SigmaDoubt.OUTLIERS
    if not declared:
        return structure, SigmaDoubt.NONE
    if related:
        if noise > NOISY and size.rms < NOISY * noise:
            return structure, SigmaDoubt.TOO_SMALL
        return (ResidualStructure.MISSING if size.large else structure), SigmaDoubt.NONE
    return structure, SigmaDoubt.TOO_SMALL if size.large else SigmaDoubt.NONE


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
