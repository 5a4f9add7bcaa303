"""Whitens coloured noise with an autoregression for each output.

The symbols are those of P. J. Brockwell and R. A. Davis: a are the coefficients, c the
autocovariances, and e the innovations.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_toeplitz

from cluster_est.statistics.records import StackedRecords
from workers.messages import FloatArray


def fit_autoregression(
    residuals: FloatArray,
    records: StackedRecords,
    order: int = 2,
    *,
    about_mean: bool = False,
) -> FloatArray:
    """Return the coefficients of r_t = a_1 r_{t-1} + ... + a_p r_{t-p} + e_t for each output.

    They satisfy the Yule-Walker equations sum_j c_|i-j| a_j = c_i. The autocovariances c about 0
    are summed over all records of the output; no product spans two records. The sums are not
    divided by their numbers of products. So the equations are positive definite and the solution is
    stationary for any residual (P. J. Brockwell, R. A. Davis, Time Series: Theory and Methods
    (1991), doi:10.1007/978-1-4419-0320-4, section 8.1).

    Parameters
    ----------
    residuals : (n,)
        Stacked residuals.
    about_mean
        Whether autocovariances are about the mean of each output over all its records. Otherwise, a
        common offset would look like noise with an infinite memory.

    Returns
    -------
    (outputs, order)
        Zeros for an output whose residual is zero.
    """
    coefficients = np.zeros((len(records.outputs), order))
    if about_mean:
        residuals = _centred(residuals, records)
    for output, row in enumerate(coefficients):
        covariances = _pooled_autocovariances(residuals, records, output, order)
        if order and covariances[0] > 0.0:
            row[:] = solve_toeplitz(covariances[:order], covariances[1:])
    return coefficients


def _centred(residuals: FloatArray, records: StackedRecords) -> FloatArray:
    centred = residuals.copy()
    for output in range(len(records.outputs)):
        rows = records.of_output(output)
        if len(rows):
            centred[rows] -= residuals[rows].mean()
    return centred


def deviance(
    residuals: FloatArray, records: StackedRecords, coefficients: FloatArray | None = None
) -> float:
    """Return -2 log likelihood of residuals up to a constant, with the noise levels estimated.

    It is the sum over outputs of n log s^2, where s^2 is the mean square of the n residuals. With
    an autoregression, s^2 is that of the innovations (`whiten`), and 2 log of the determinant of
    the whitening matrix is subtracted.

    Parameters
    ----------
    residuals : (n,)
        Stacked residuals.
    coefficients : (outputs, order)
        Coefficients from `fit_autoregression`; None for white noise.

    Raises
    ------
    ValueError
        If an autoregression is not stationary.
    """
    white, determinant = residuals, 0.0
    if coefficients is not None:
        white = whiten(residuals, records, coefficients)
        scales = [np.array([scale for _, scale in _lower_orders(row)]) for row in coefficients]
        determinant = sum(
            float(np.log(scales[item.output][: len(item.times)]).sum()) for item in records.items
        )
    total = -2.0 * determinant
    for output in range(len(records.outputs)):
        part = white[records.of_output(output)]
        if len(part):
            total += len(part) * np.log(max(float(np.mean(part**2)), 1e-300))
    return float(total)


def partial_autocorrelations(
    residuals: FloatArray, records: StackedRecords, output: int, order: int
) -> FloatArray:
    """Return the partial autocorrelations of an output at lags 1 to order, over all its records.

    For an autoregression of order p, they are 0 beyond lag p, with a standard error of 1 / sqrt(n)
    (M. H. Quenouille, J. R. Stat. Soc. B 11 (1949) 68-84,
    doi:10.1111/j.2517-6161.1949.tb00023.x).

    Parameters
    ----------
    residuals : (n,)
        Stacked residuals.

    Returns
    -------
    (order,)
        Zeros for an output whose residual is zero.
    """
    covariances = _pooled_autocovariances(residuals, records, output, order)
    found = np.zeros(order)
    if not covariances[0] > 0.0:
        return found
    for lag in range(1, order + 1):
        found[lag - 1] = solve_toeplitz(covariances[:lag], covariances[1 : lag + 1])[-1]
    return found


def whiten(a: FloatArray, records: StackedRecords, coefficients: FloatArray) -> FloatArray:
    """Return the innovations e_t of each record, with the same number of rows.

    The first samples of a record have fewer predecessors than the order. Each is predicted by the
    autoregression of the lower order, and scaled to the variance of e. So the filter is the exact
    inverse square root of the covariance of a stationary autoregression. No rows are lost, and
    `records` stay valid.

    The filter is linear. Apply it to residuals, sensitivities and candidates.

    Parameters
    ----------
    a : (n,) or (n, m)
        Stacked signals; columns are filtered separately.
    coefficients : (outputs, order)
        Coefficients from `fit_autoregression`.

    Raises
    ------
    ValueError
        If an autoregression is not stationary.
    """
    starts = [_lower_orders(row) for row in coefficients]
    white = np.array(a, dtype=float)
    for item in records.items:
        past, now = a[item.rows], white[item.rows]
        full = coefficients[item.output]
        for lag, coefficient in enumerate(full, start=1):
            now[lag:] -= coefficient * past[:-lag]
        for t, (lower, scale) in enumerate(starts[item.output][: len(past)]):
            now[t] = scale * (past[t] - np.tensordot(lower, past[:t][::-1], axes=1))
    return white


def _pooled_autocovariances(
    residuals: FloatArray, records: StackedRecords, output: int, order: int
) -> FloatArray:
    """Return the autocovariances of an output, summed over its records; no product spans two."""
    signals = [residuals[item.rows] for item in records.items if item.output == output]
    return sum((_autocovariances(s, order) for s in signals), np.zeros(order + 1))


def _autocovariances(signal: FloatArray, order: int) -> FloatArray:
    """Return the sums of r_t r_{t+k} for k = 0 to order."""
    length = len(signal)
    lags = [np.add.reduce(signal[k:] * signal[: max(length - k, 0)]) for k in range(order + 1)]
    return np.array(lags)


def _lower_orders(coefficients: FloatArray) -> list[tuple[FloatArray, float]]:
    """Return the predictors of order 0 to p - 1, and the factors that scale their errors.

    This is the Levinson-Durbin recursion in reverse: a'_k = (a_k + a_p a_{p-k}) / (1 - a_p^2), and
    the variance of the error grows by 1 / (1 - a_p^2). Scaled errors have the variance of order p.
    """
    predictors: list[tuple[FloatArray, float]] = []
    current, shrink = coefficients, 1.0
    while len(current):
        last = float(current[-1])
        if abs(last) >= 1.0:
            raise ValueError(f"the autoregression {coefficients} is not stationary")
        left = 1.0 - last**2
        current = (current[:-1] + last * current[:-1][::-1]) / left
        shrink *= left
        predictors.append((current, float(np.sqrt(shrink))))
    return predictors[::-1]
