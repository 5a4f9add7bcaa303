"""An extended Kalman filter along one simulation of a model.

Between two times of the grid the states follow the model, and their covariance its linearisation at
the filtered states:

    dP/dt = A P + P A' + Q,    Q = diag(q^2).

At a measured time each output updates both, one after the other, as their noises are independent:
with the innovation e = y - g(x) - C (x' - x), x' having the updates before it,

    S = C P C' + R,    K = P C' / S,    x' += K e,    P -= K S K'.

References: A. H. Jazwinski, Stochastic Processes and Filtering Theory (1970), section 8.3; G. J.
Bierman, Factorization Methods for Discrete Sequential Estimation (1977), for the order of updates.
"""

from __future__ import annotations

from typing import NamedTuple

from workers.kernels.fmi.compiling import kernel, subroutine
from workers.kernels.fmi.failure import FINISHED, OUTPUT, failed
from workers.kernels.fmi.hooks import select_point
from workers.kernels.fmi.reference import by_reference
from workers.kernels.fmi.values import DISCARD
from workers.kernels.linearise import LINEARISATION, linearise_at, step_on_grid
from workers.kernels.model_exchange.evaluation import record_outputs, set_time_and_states
from workers.kernels.model_exchange.solver_steps import handle_input_jump, start_simulation
from workers.messages import FloatArray

SHORT = 0.1
"""Norm of A h up to which F and the integral of F Q F' are taken from their series."""
TERMS = 7
"""Of these series."""
MOST_DOUBLINGS = 60


class KalmanArrays(NamedTuple):
    """Noise and measurements, results, and memory.

    Attributes
    ----------
    diffusion : (x,)
        q^2 of each state: the variance that its derivative's noise gives it in a second.
    measured : (n, y)
        NaN where an output was not measured.
    variances : (n, y)
        R.
    innovations, spreads : (n, y)
        Filled with e, and with S.
    covariance, transition, noise, product, other : (x, x)
        P, F, the integral of F Q F' over a step, and memory.
    change, gain : (x,)
        What updates add to the states, and K.
    """

    diffusion: FloatArray
    measured: FloatArray
    variances: FloatArray
    innovations: FloatArray
    spreads: FloatArray
    covariance: FloatArray
    transition: FloatArray
    noise: FloatArray
    product: FloatArray
    other: FloatArray
    change: FloatArray
    gain: FloatArray


@kernel
def filter_states(  # type: ignore[no-untyped-def]
    stepping, c, references, starts, settings, hooks, offsets, grid, point, work, perturbed, result,
    kalman, outputs,
):  # fmt: skip
    """Simulate one experiment for one point, and correct the states at every measured time.

    Parameters
    ----------
    stepping
        As for `linearise`, without PRECOMPUTED.
    hooks, offsets, perturbed, result
        As for `linearise`. The derivatives are those at the filtered states.
    kalman
        Filled with innovations and their variances.
    outputs : (n, y)
        Filled with the outputs as predicted from all measurements before.

    Returns
    -------
    (code, time)
        0, or what went wrong, and the time of it.
    """
    c, references, starts, settings, hooks, offsets, grid, work = by_reference(
        (c, references, starts, settings, hooks, offsets, grid, work)
    )
    perturbed, result, kalman = by_reference((perturbed, result, kalman))
    times, most = grid.times, settings.max_steps
    time, proposed = times[0], 0.0
    select_point(hooks, 0, work)
    code = start_simulation(c, references, starts, settings, hooks, grid, point, work)
    for i in range(len(times)):
        if code == FINISHED:
            code = handle_input_jump(c, references, settings, hooks, grid, i, time, work)
        if code != FINISHED:
            return code, time
        status = record_outputs(c, references, hooks, grid, i, time, work, outputs[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), time
        status = linearise_at(c, references, hooks, offsets, grid, i, work, perturbed, result)
        if status < DISCARD and _update(i, outputs[i], work.states, result.C[i], kalman):
            status = set_time_and_states(c, references, hooks, time, work.states, work)
            if status < DISCARD:
                status = linearise_at(
                    c, references, hooks, offsets, grid, i, work, perturbed, result
                )
        if status >= DISCARD:
            return failed(LINEARISATION, status), time
        if i + 1 == len(times):
            break
        _predict(result.A[i], times[i + 1] - times[i], kalman)
        code, time, proposed, _ = step_on_grid(
            stepping, c, references, settings, hooks, grid, i, time, proposed, most, work, result,
        )  # fmt: skip
    return code, time


@subroutine
def _update(i, predicted, states, by_states, kalman):  # type: ignore[no-untyped-def]
    """Correct states and covariance by what was measured at grid time i; return whether it was."""
    change, measured = kalman.change, False
    for r in range(len(states)):
        change[r] = 0.0
    for j in range(len(predicted)):
        y = kalman.measured[i, j]
        if y == y:  # NaN is not
            measured = True
            _correct(i, j, y - predicted[j], by_states[j], kalman)
    for r in range(len(states)):
        states[r] += change[r]
    return measured


@subroutine
def _correct(i, j, innovation, by_states, kalman):  # type: ignore[no-untyped-def]
    """Add the correction by output j, whose derivatives by the states are given."""
    covariance, change, gain = kalman.covariance, kalman.change, kalman.gain
    n, spread = len(change), kalman.variances[i, j]
    for r in range(n):
        innovation -= by_states[r] * change[r]
        gain[r] = 0.0
        for k in range(n):
            gain[r] += covariance[r, k] * by_states[k]
    for r in range(n):
        spread += by_states[r] * gain[r]
    kalman.innovations[i, j] = innovation
    kalman.spreads[i, j] = spread
    for r in range(n):
        change[r] += gain[r] / spread * innovation
        for k in range(n):
            covariance[r, k] -= gain[r] * gain[k] / spread


@subroutine
def _predict(dynamics, seconds, kalman):  # type: ignore[no-untyped-def]
    """Carry the covariance over a step: P = F P F' + the integral of F Q F'."""
    transition, noise, other = kalman.transition, kalman.noise, kalman.other
    h, doublings = seconds, 0
    size = _norm(dynamics)
    while size * h > SHORT and doublings < MOST_DOUBLINGS:
        h, doublings = 0.5 * h, doublings + 1
    _short_step(dynamics, h, kalman)
    for _ in range(doublings):  # G(2h) = G(h) + F(h) G(h) F(h)',  F(2h) = F(h) F(h)
        _congruence(noise, kalman)
        _add(other, noise)
        _multiply(transition, transition, other)
        for r in range(len(other)):
            for k in range(len(other)):
                transition[r, k] = other[r, k]
    covariance = kalman.covariance
    _congruence(covariance, kalman)
    for r in range(len(other)):
        for k in range(len(other)):
            covariance[r, k] = 0.5 * (other[r, k] + other[k, r]) + noise[r, k]


@subroutine
def _norm(matrix):  # type: ignore[no-untyped-def]
    """Return the largest sum of magnitudes in a row."""
    largest = 0.0
    for r in range(len(matrix)):
        total = 0.0
        for k in range(len(matrix)):
            total += abs(matrix[r, k])
        largest = max(largest, total)
    return largest


@subroutine
def _short_step(dynamics, h, kalman):  # type: ignore[no-untyped-def]
    """Fill in the series of F = exp(A h) and of the integral of F Q F'."""
    product, other = kalman.product, kalman.other
    _fill_diagonal(product, kalman.diffusion, 0.0, 1.0)
    _fill_diagonal(kalman.transition, kalman.diffusion, 0.0, 1.0)
    for order in range(1, TERMS):  # (A h)^i / i!
        _multiply(product, dynamics, other)
        _scale(other, product, h / order, 0.0)
        _add(product, kalman.transition)
    _fill_diagonal(product, kalman.diffusion, h, 0.0)
    _fill_diagonal(kalman.noise, kalman.diffusion, h, 0.0)
    for order in range(1, TERMS):  # h^(i + 1) / (i + 1)! of the i-th derivative, A M + M A'
        _multiply(dynamics, product, other)
        _scale(other, product, h / (order + 1), h / (order + 1))
        _add(product, kalman.noise)


@subroutine
def _fill_diagonal(matrix, values, factor, constant):  # type: ignore[no-untyped-def]
    for r in range(len(matrix)):
        for k in range(len(matrix)):
            matrix[r, k] = factor * values[r] + constant if r == k else 0.0


@subroutine
def _scale(one, result, factor, transposed):  # type: ignore[no-untyped-def]
    """Fill in a multiple of a matrix, and of its transpose."""
    for r in range(len(one)):
        for k in range(len(one)):
            result[r, k] = factor * one[r, k] + transposed * one[k, r]


@subroutine
def _congruence(matrix, kalman):  # type: ignore[no-untyped-def]
    """Fill in F M F'."""
    transition, product, other = kalman.transition, kalman.product, kalman.other
    n = len(matrix)
    _multiply(transition, matrix, product)
    for r in range(n):
        for k in range(n):
            total = 0.0
            for m in range(n):
                total += product[r, m] * transition[k, m]
            other[r, k] = total


@subroutine
def _multiply(one, two, result):  # type: ignore[no-untyped-def]
    n = len(one)
    for r in range(n):
        for k in range(n):
            total = 0.0
            for m in range(n):
                total += one[r, m] * two[m, k]
            result[r, k] = total


@subroutine
def _add(one, result):  # type: ignore[no-untyped-def]
    for r in range(len(one)):
        for k in range(len(one)):
            result[r, k] += one[r, k]
