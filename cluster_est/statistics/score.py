"""Score tests of candidate directions, and the distribution of the best one by chance.

The symbols are those of the references: r is the residual, D the columns of a candidate, P the
projection, B an orthonormal basis of P D, and T the statistic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from scipy.linalg.lapack import dpstrf
from scipy.special import gammaincc, gammaln, log_ndtr

from cluster_est.statistics.projection import NOTHING_LEFT, OrthogonalProjection
from workers.messages import FloatArray, IntArray

CONFOUNDED = 5e-3
"""Share of a direction outside the parameters below which it cannot be distinguished from them,
because linearisations of a simulation are not more accurate."""

NEARLY_DEPENDENT_COLUMNS = 1e-3
"""Least ratio of a singular value of a candidate's scaled columns to the largest one; directions
with smaller values come from errors of the simulations."""

CERTAIN = 1e-6
"""If the probability that any draw beats the best candidate is below this, no draws are made."""

NEARLY_DEPENDENT_BASES = 1e-10
"""Relative squared length below which the rest of a basis vector, after projection on the others,
counts as zero."""


@dataclass(frozen=True)
class ScoreTests:
    """Score tests of candidates, in the given order.

    Attributes
    ----------
    statistics : (candidates,)
        T = |B' P r|^2 / s^2, chi-squared with `df` degrees of freedom if no effect is missing.
    df : (candidates,)
        Number of independent directions; 0 for a candidate that was set aside because the declared
        parameters can imitate it.
    ratio : (candidates,)
        |P D| / |D|: the share of the candidate that the parameters cannot imitate.
    log_p : (candidates,)
        Natural logarithm of the p-value. Use it for a ranking, because p itself may underflow.
    explained : (candidates,)
        R2: the share of the projected residual's sum of squares that the candidate would remove.
    bases : (n, sum of df)
        Orthonormal within each candidate and orthogonal to the declared parameters.
    offsets : (candidates + 1,)
        Candidate k has the columns offsets[k] to offsets[k + 1] of `bases`.
    coordinates : (sum of df,)
        B' P r / s of all candidates; the sum of a candidate's squares is its statistic.
    variance
        s^2 = |P r|^2 / degrees; 0 if the projected residual is 0.
    degrees
        n minus the rank of the projection.
    """

    statistics: FloatArray
    df: IntArray
    ratio: FloatArray
    log_p: FloatArray
    explained: FloatArray
    bases: FloatArray = field(repr=False)
    offsets: IntArray = field(repr=False)
    coordinates: FloatArray = field(repr=False)
    variance: float
    degrees: int

    @property
    def p_values(self) -> FloatArray:
        """The p-value of each single candidate; 1 for candidates that were set aside."""
        return np.exp(self.log_p)

    def first(self, count: int) -> Self:
        """Return the tests of the first candidates."""
        stop = int(self.offsets[count])
        return replace(
            self,
            statistics=self.statistics[:count],
            df=self.df[:count],
            ratio=self.ratio[:count],
            log_p=self.log_p[:count],
            explained=self.explained[:count],
            bases=self.bases[:, :stop],
            offsets=self.offsets[: count + 1],
            coordinates=self.coordinates[:stop],
        )

    def with_more(self, more: ScoreTests) -> Self:
        """Return these tests, followed by tests of further candidates for the same residual."""
        return replace(
            self,
            statistics=np.concatenate([self.statistics, more.statistics]),
            df=np.concatenate([self.df, more.df]),
            ratio=np.concatenate([self.ratio, more.ratio]),
            log_p=np.concatenate([self.log_p, more.log_p]),
            explained=np.concatenate([self.explained, more.explained]),
            bases=np.hstack([self.bases, more.bases]),
            offsets=np.concatenate([self.offsets, self.offsets[-1] + more.offsets[1:]]),
            coordinates=np.concatenate([self.coordinates, more.coordinates]),
        )

    def without_bases(self) -> Self:
        """Return the tests without bases, which need by far the most memory."""
        return replace(self, bases=np.zeros((len(self.bases), 0)))


def score(
    projection: OrthogonalProjection,
    residuals: FloatArray,
    columns: Sequence[FloatArray],
    confounded: float = CONFOUNDED,
    change: Callable[[FloatArray], FloatArray] | None = None,
) -> ScoreTests:
    """Test for each candidate whether it would reduce the residual by more than chance.

    This is Rao's score test (Lagrange multiplier test). P is the projection that removes the
    declared parameters, B an orthonormal basis of P D, s^2 = |P r|^2 / (n - rank), and
    T = |B' P r|^2 / s^2 (C. R. Rao, Proc. Cambridge Philos. Soc. 44 (1948) 50-57,
    doi:10.1017/S0305004100023987). The test needs only the candidate's direction at zero strength,
    and no refit.

    A direction counts if a sufficient share of it lies outside the declared parameters. Dependent
    columns of a candidate are dropped. The result does not depend on the scales of residual and
    columns, or on the order of the candidates.

    Parameters
    ----------
    projection
        Removes the sensitivities to the declared parameters.
    residuals : (n,)
        Residuals of all records.
    columns : each (n, d)
        Derivatives of the residuals with respect to a candidate's coefficients; usually d = 1.
    confounded
        Least share of a direction that must lie outside the declared parameters.
    change
        Function that is first applied to the columns of each candidate.
    """
    sizes = [column.shape[1] for column in columns]
    units = np.empty((sum(sizes), len(residuals)))  # transposed: each column is contiguous
    for (start, stop), column in zip(_blocks(sizes), columns, strict=True):
        units[start:stop] = (column if change is None else change(column)).T
    owners = np.repeat(np.arange(len(columns)), sizes)
    lengths = _normalise(units)
    bases = projection.remove(units.T).T
    shares = _normalise(bases)
    usable = _usable(lengths, shares, owners, len(columns), confounded)
    for start, stop in _blocks(sizes):
        if stop - start > 1 and usable[start:stop].any():
            rows = start + np.flatnonzero(usable[start:stop])
            basis = _orthonormal(units[rows], bases[rows] * shares[rows, None], confounded)
            usable[rows[len(basis) :]] = False
            bases[rows[: len(basis)]] = basis
    ratio = np.sqrt(_summed((lengths * shares) ** 2, owners, len(columns)))
    total = np.sqrt(_summed(lengths**2, owners, len(columns)))
    ratio /= np.where(total > 0.0, total, 1.0)
    del units  # each copy is large
    bases = bases[usable]
    return _tested(projection, residuals, bases.T, owners[usable], ratio)


def family_wise(scores: ScoreTests, generator: np.random.Generator, draws: int = 2000) -> float:
    """Return the probability that, on white noise, the best candidate is at least as good.

    The smallest p-value of all candidates is compared with its distribution under the null
    hypothesis, which includes the correlation of the candidates. For white noise e, B' e = L z with
    L L' = B' B and z ~ N(0, I), and |P e|^2 = |z|^2 plus a chi-squared number for the remaining
    degrees of freedom. So z is drawn instead of e, which is exact and independent of n (P. H.
    Westfall, S. S. Young, Resampling-Based Multiple Testing (1993), chapter 2).

    If no draw is better, p is limited by Bonferroni's inequality, so strong evidence can also be
    ranked. If this bound shows that no draw would be better, no draws are made.

    Parameters
    ----------
    draws
        Number of draws; 2000 give a standard error of 0.002 at p = 0.01.
    """
    tested = int((scores.df > 0).sum())
    if not tested or scores.variance == 0.0:
        return 1.0
    least = float(scores.log_p.min())
    bound = tested * float(np.exp(least))
    if draws * bound < CERTAIN:
        return bound
    beaten = int((_null_of_least(scores, generator, draws) <= least).sum())
    p = (1 + beaten) / (draws + 1)
    return p if beaten else min(p, bound)


def log_survival(statistics: FloatArray, df: IntArray) -> FloatArray:
    """Return the logarithm of the probability that a chi-squared number exceeds each statistic.

    If the probability itself underflows (for statistics above about 1500), the contracted continued
    fraction of the incomplete gamma function is used, https://dlmf.nist.gov/8.9.E2. For `df` = 0
    the result is 0.
    """
    statistics, df = np.broadcast_arrays(np.asarray(statistics, dtype=float), df)
    a, x = df / 2.0, statistics / 2.0
    result = np.zeros(a.shape)
    one = df == 1
    # the most frequent case, without any loss of accuracy
    result[one] = np.log(2.0) + log_ndtr(-np.sqrt(statistics[one]))
    more = df > 1
    survival = gammaincc(a[more], x[more])
    far = survival < 1e-280
    found = np.log(np.where(far, 1.0, survival))
    found[far] = _far_tail(a[more][far], x[more][far])
    result[more] = found
    return result


def _far_tail(a: FloatArray, x: FloatArray) -> FloatArray:
    """Return the logarithm of gammaincc(a, x) for x far above a."""
    fraction = np.zeros_like(x)
    for k in range(30, 0, -1):
        fraction = -k * (k - a) / (x + 2 * k + 1 - a + fraction)
    tail: FloatArray = a * np.log(x) - x - gammaln(a) - np.log(x + 1.0 - a + fraction)
    return tail


def _tested(
    projection: OrthogonalProjection,
    residuals: FloatArray,
    bases: FloatArray,
    owners: IntArray,
    ratio: FloatArray,
) -> ScoreTests:
    """Return the tests; `owners` are the indices of the candidates of the basis columns."""
    left = projection.remove(residuals)
    square, degrees = float(left @ left), projection.degrees
    if square <= NOTHING_LEFT**2 * float(residuals @ residuals):
        square = 0.0
    variance = square / max(degrees, 1)
    coordinates = bases.T @ left / np.sqrt(variance) if variance > 0.0 else np.zeros(len(owners))
    statistics = _summed(coordinates**2, owners, len(ratio))
    df = np.bincount(owners, minlength=len(ratio))
    return ScoreTests(
        statistics=statistics,
        df=df,
        ratio=ratio,
        log_p=log_survival(statistics, df),
        explained=statistics / max(degrees, 1),
        bases=bases,
        offsets=np.concatenate([[0], np.cumsum(df)]),
        coordinates=coordinates,
        variance=variance,
        degrees=degrees,
    )


LARGEST_SQUARABLE_LENGTH = 1e150
"""Largest length of a direction whose square does not overflow."""


def _normalise(rows: FloatArray) -> FloatArray:
    """Scale rows to length 1 in place, except zero rows, and return their lengths before.

    Rows whose squares would overflow, as with a diverging trajectory, become zero.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        lengths: FloatArray = np.linalg.norm(rows, axis=1)
    wild = ~(lengths < LARGEST_SQUARABLE_LENGTH)
    rows[wild], lengths[wild] = 0.0, 0.0
    rows /= np.where(lengths > 0.0, lengths, 1.0)[:, None]
    return lengths


def _usable(
    lengths: FloatArray, shares: FloatArray, owners: IntArray, count: int, confounded: float
) -> IntArray:
    """Return a mask of usable columns.

    They are not confounded with the parameters, and not negligible within their candidate.
    """
    longest = np.zeros(count)
    np.maximum.at(longest, owners, lengths)
    return (shares >= confounded) & (lengths > 1e-9 * longest[owners])


def _orthonormal(units: FloatArray, outside: FloatArray, confounded: float) -> FloatArray:
    """Return orthonormal rows that span a candidate's usable directions outside the parameters.

    First, dependent directions of the candidate are dropped. Then those directions are dropped that
    the parameters can imitate: the singular values of the projected orthonormal basis are the sines
    of its angles to the parameters.
    """
    values, vectors = np.linalg.eigh(units @ units.T)
    kept = values > NEARLY_DEPENDENT_COLUMNS**2 * values[-1]
    mixing = vectors[:, kept] / np.sqrt(values[kept])
    directions = mixing.T @ outside
    squares, turn = np.linalg.eigh(directions @ directions.T)
    clear = turn[:, squares >= confounded**2]
    return np.ascontiguousarray(np.linalg.qr((clear.T @ directions).T)[0].T)


def _null_of_least(scores: ScoreTests, generator: np.random.Generator, draws: int) -> FloatArray:
    """Return the log of the smallest p-value for draws under the null hypothesis: (draws,)."""
    factor = _root(scores.bases.T @ scores.bases)
    z = generator.standard_normal((draws, factor.shape[1]))
    rest = scores.degrees - factor.shape[1]
    square = (z**2).sum(axis=1) + (generator.chisquare(rest, draws) if rest > 0 else 0.0)
    squares = (z @ factor.T) ** 2 / (square / scores.degrees)[:, None]
    present = scores.df > 0
    statistics = np.add.reduceat(squares, scores.offsets[:-1][present], axis=1)
    least = np.zeros(draws)
    # for equal df, the largest statistic has the smallest p-value, so few logarithms are needed
    for df in np.unique(scores.df[present]):
        largest = statistics[:, scores.df[present] == df].max(axis=1)
        least = np.minimum(least, log_survival(largest, df))
    return least


def _root(matrix: FloatArray) -> FloatArray:
    """Return L, (m, rank), with L L' equal to a positive semidefinite matrix, (m, m).

    This is a Cholesky factorisation with complete pivoting, which ends when the remaining diagonal
    is negligible. It takes rank^2 m operations, a tenth of those of an eigendecomposition. The
    trace of the remainder is below m times `NEARLY_DEPENDENT_BASES` (N. J. Higham, in: Reliable
    Numerical Computation (Oxford University Press, 1990) 161-185).
    """
    least = NEARLY_DEPENDENT_BASES * float(np.diag(matrix).max())
    upper, pivots, rank, _ = dpstrf(matrix, tol=least)
    root = np.zeros((len(matrix), rank))
    root[pivots - 1] = np.triu(upper)[:rank].T
    return root


def _summed(values: FloatArray, owners: IntArray, count: int) -> FloatArray:
    """Return the sum of the values of each owner."""
    sums: FloatArray = np.bincount(owners, values, count).astype(float)
    return sums


def _blocks(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """Return start and stop of consecutive blocks."""
    stops = np.cumsum(sizes, dtype=int).tolist()
    return list(zip([0, *stops], stops, strict=False))
