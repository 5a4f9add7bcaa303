"""Step responses of free filters, and the few numbers that say the same.

A free filter has n equal lags in a row, of which it adds k_i z_i. After a step of 1 of its
argument, lag i is at the regularised incomplete gamma function P(i, t / tau), so the filter goes

    c(t) = sum k_i P(i, t / tau)

on its way from where the step has put it at once to sum k_i more. A balanced truncation (B. C.
Moore, IEEE Trans. Automatic Control 26 (1981) 17-32, doi:10.1109/TAC.1981.1102568) says whether one
or two time constants do nearly the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import cholesky, solve_continuous_lyapunov, svd
from scipy.special import gammainc

from cluster_est.problem.display import readable_time
from workers.effects.kinds import EffectForm
from workers.effects.laws import Law
from workers.messages import FloatArray

SETTLED = 12.0
"""Time constants behind those of its order after which a filter is drawn to be settled."""
PART = 1.0 - np.exp(-1.0)
"""Of its way: what a single lag does within its time constant."""
NO_WAY = 0.05
"""Share of its largest deflection below which a filter comes back to where it was."""
REDUCED = 0.05
"""Share of the Hankel singular values that a reduced model may leave out."""


def filter_parts(form: EffectForm, values: FloatArray) -> tuple[FloatArray, float]:
    """Return the strengths of a free filter and its time constant, by the order of its form."""
    order = len(form.states)
    return values[:order], float(values[order])


def settled_after(form: EffectForm, values: FloatArray) -> float:
    """Return a time after which the step response of a free filter moves no more."""
    strengths, tau = filter_parts(form, values)
    return (len(strengths) + SETTLED) * tau


def step_response(form: EffectForm) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return the response of a free filter to a step of 1 at 0, over times and coefficients.

    At an input or output in the place of a signal's own step, what that becomes.
    """

    def response(t: FloatArray, values: FloatArray) -> FloatArray:
        strengths, tau = filter_parts(form, values)
        total = float(strengths.sum())
        begins = {Law.EXCHANGE: -total, Law.SIGNAL_DYNAMICS: 1.0 - total}.get(form.law, 0.0)
        return np.asarray(begins + _way(strengths, t / tau))

    return response


def _way(strengths: FloatArray, x: FloatArray) -> FloatArray:
    lags = gammainc(np.arange(1.0, len(strengths) + 1.0)[:, None], np.maximum(x, 0.0))
    return np.asarray(strengths @ lags)


def dynamics_in_words(form: EffectForm, values: Sequence[float]) -> str:
    """Say how fast the step response is, and what a reduced model has; "" if unknown."""
    strengths, tau = filter_parts(form, np.array(values, float))
    if not (np.isfinite(strengths).all() and tau > 0.0 and strengths.any()):
        return ""
    x = np.linspace(0.0, len(strengths) + SETTLED, 20_001)
    way, total = _way(strengths, x), float(strengths.sum())
    said = "the step response returns to its initial value"
    if abs(total) > NO_WAY * float(np.abs(way).max()):
        done = x[np.argmax(way / total >= PART)] * tau
        said = f"the step response reaches 63 % after {readable_time(float(done))}"
    times = [readable_time(float(each)) for each in reduced_time_constants(strengths, tau)]
    if not times:
        return said
    which = "time constants" if len(times) > 1 else "time constant"
    return f"{said}; a model with the {which} {' and '.join(times)} has nearly the same response"


def reduced_time_constants(strengths: FloatArray, tau: float) -> FloatArray:
    """Return the one or two time constants of a reduced model, the fast one first.

    None where it needs more, or would swing.
    """
    n = len(strengths)
    a = np.eye(n, k=-1) - np.eye(n)
    b, c = np.eye(n, 1), strengths[None, :] / float(np.abs(strengths).max())
    into = cholesky(solve_continuous_lyapunov(a, -b @ b.T), lower=True)
    out_of, found = np.linalg.eigh(solve_continuous_lyapunov(a.T, -c.T @ c))
    out = found * np.sqrt(np.maximum(out_of, 0.0))
    left, hankel, right = svd(out.T @ into)
    for order in (1, 2):
        if hankel[order:].sum() <= REDUCED * hankel.sum():
            scale = 1.0 / np.sqrt(hankel[:order])
            back = scale[:, None] * (left[:, :order].T @ out.T)
            there = (into @ right[:order].T) * scale
            poles = np.linalg.eigvals(back @ a @ there)
            swings = np.iscomplex(poles).any()
            return np.zeros(0) if swings else np.sort(-tau / poles.real)
    return np.zeros(0)
