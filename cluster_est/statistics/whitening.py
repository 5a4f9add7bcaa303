"""Coloured noise made white, by an autoregression for each output.

Symbols are those of P. J. Brockwell and R. A. Davis: a the coefficients, c the autocovariances, e
the innovations.
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
    """Coefficients of r_t = a_1 r_{t-1} + ... + a_p r_{t-p} + e_t for each output.

    The Yule-Walker equations sum_j c_|i-j| a_j = c_i, with autocovariances c about 0 that are
    summed over all records of the output (no product spans two records). Sums that are not
    divided by their number of products make the equations positive definite and the solution
    stationary, however smooth the residual is: P. J. Brockwell, R. A. Davis, Time Series: Theory
    and Methods (1991), doi:10.1007/978-1-4419-0320-4, section 8.1.

    Parameters
    ----------
    residuals : (n,)
        Stacked.
    about_mean
        Autocovariances about the mean of each output over all its records: else an offset that they
        share would look like noise that never forgets.

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
    """-2 log likelihood of residuals, but for a constant, with the noise of each output estimated.

    The sum over outputs of n log s^2, s^2 being the mean square of the n residuals. With an
    autoregression, that of its innovations (`whiten`), and less 2 log of the determinant of what
    makes the residuals white.

    Parameters
    ----------
    residuals : (n,)
        Stacked.
    coefficients : (outputs, order)
        Of the autoregressions, such as `fit_autoregression` gives them; None for white noise.

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
    """Partial autocorrelations of one output at lags 1 ... order, pooled over its records.

    The partial autocorrelations of an autoregression of order p are 0 beyond lag p, with a standard
    error of 1 / sqrt(n):
    M. H. Quenouille, J. R. Stat. Soc. B 11 (1949) 68-84, doi:10.1111/j.2517-6161.1949.tb00023.x.

    Parameters
    ----------
    residuals : (n,)
        Stacked.

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
    """Each record filtered to its innovations e_t; as many rows as before.

    The first samples of a record lack a full past. Each is predicted from the past that it has by
    the autoregression of that lower order, and scaled to the variance of e. With that the map is
    the exact inverse square root of the covariance of a stationary autoregression, none of the
    record is lost, and `records` stay valid.

    Being linear, it belongs on residuals, sensitivities and candidates alike.

    Parameters
    ----------
    a : (n,) or (n, m)
        Stacked; columns are filtered independently.
    coefficients : (outputs, order)
        From `fit_autoregression`.

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
    """Autocovariances of one output, summed over its records; no product spans two."""
    signals = [residuals[item.rows] for item in records.items if item.output == output]
    return sum((_autocovariances(s, order) for s in signals), np.zeros(order + 1))


def _autocovariances(signal: FloatArray, order: int) -> FloatArray:
    """Sums of r_t r_{t+k}, k = 0 ... order."""
    length = len(signal)
    lags = [np.add.reduce(signal[k:] * signal[: max(length - k, 0)]) for k in range(order + 1)]
    return np.array(lags)


def _lower_orders(coefficients: FloatArray) -> list[tuple[FloatArray, float]]:
    """Predictors of order 0 ... p - 1 and the scale of their errors to those of order p.

    The Levinson-Durbin recursion run downwards: a'_k = (a_k + a_p a_{p-k}) / (1 - a_p^2), and the
    variance of the error grows by 1 / (1 - a_p^2).
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
