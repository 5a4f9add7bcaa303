"""Step and frequency responses of free filters, and their reduced models.

A free filter has n equal lags in series, and adds the sum of k_i z_i. After a unit step of its
argument, lag i is the regularised incomplete gamma function P(i, t / tau). Its frequency response
is a power of the transfer function of one lag:

    c(t) = d + sum k_i P(i, t / tau)        H(f) = d + sum k_i (1 + 2 pi j f tau)^-i

d is the direct feedthrough. A balanced truncation (B. C. Moore, IEEE Trans. Automatic Control 26
(1981) 17-32, doi:10.1109/TAC.1981.1102568) shows whether a model with one or two time constants has
nearly the same response.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_continuous_lyapunov, svd
from scipy.special import gammainc

from cluster_est.problem.display import readable_time
from workers.effects.kinds import EffectForm
from workers.effects.laws import Law
from workers.messages import Experiment, FloatArray

SETTLED = 12.0
"""Number of time constants, in addition to the order, after which a filter has settled."""
PART = 1.0 - np.exp(-1.0)
"""Share of its final value that a single lag reaches within its time constant."""
NO_WAY = 0.05
"""Final value over the largest deflection below which a filter returns to its initial value."""
DECADE = 10.0
"""Ratio of the ends of a plotted frequency range to the corner frequency of the lags."""
REDUCED = 0.05
"""Largest share of the Hankel singular values that a reduced model leaves out."""


def filter_parts(form: EffectForm, values: FloatArray) -> tuple[FloatArray, float]:
    """Return the strengths of a free filter and its time constant."""
    order = len(form.states)
    return values[:order], float(values[order])


def settled_after(form: EffectForm, values: FloatArray) -> float:
    """Return a time after which the step response of a free filter has settled."""
    strengths, tau = filter_parts(form, values)
    return (len(strengths) + SETTLED) * tau


def shown_frequencies(
    form: EffectForm, values: FloatArray, experiments: Sequence[Experiment]
) -> tuple[float, float]:
    """Return the frequency range of plots in Hz: around the corner frequency, limited by the data.

    The data cover the range from one period in the longest record to the Nyquist frequency.
    """
    corner = 0.5 / (np.pi * filter_parts(form, values)[1])
    around = corner / DECADE, corner * DECADE
    first = 1.0 / max(e.stop - e.start for e in experiments)
    rates = (len(o.times) / (e.stop - e.start) for e in experiments for o in e.outputs)
    low, high = max(around[0], first), min(around[1], 0.5 * max(rates, default=np.inf))
    return (low, high) if low < high else around


Response = Callable[[FloatArray, FloatArray], FloatArray]
"""A response of a free filter as a function of times or frequencies and of its coefficients.

At an input or output that the filter replaces, it is the response of the new signal.
"""


def _at_once(form: EffectForm, strengths: FloatArray) -> float:
    total = float(strengths.sum())
    return {Law.EXCHANGE: -total, Law.SIGNAL_DYNAMICS: 1.0 - total}.get(form.law, 0.0)


def step_response(form: EffectForm) -> Response:
    """Return the response of a free filter to a unit step at time 0."""

    def response(t: FloatArray, values: FloatArray) -> FloatArray:
        strengths, tau = filter_parts(form, values)
        return np.asarray(_at_once(form, strengths) + _way(strengths, t / tau))

    return response


def bode_plot(form: EffectForm) -> tuple[Response, Response]:
    """Return the magnitude of a free filter in dB and its phase in degrees as functions of f in Hz.

    The phase is a continuous function of f.
    """

    def complex_gain(f: FloatArray, values: FloatArray) -> NDArray[np.complex128]:
        strengths, tau = filter_parts(form, values)
        lag = 1.0 / (1.0 + 2j * np.pi * f * tau)
        return np.asarray(_at_once(form, strengths) + np.polyval([*strengths[::-1], 0.0], lag))

    def magnitude(f: FloatArray, values: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.asarray(20.0 * np.log10(np.abs(complex_gain(f, values))))

    def phase(f: FloatArray, values: FloatArray) -> FloatArray:
        turned = np.angle(complex_gain(f, values) * np.exp(0.25j * np.pi))  # no branch cut at -1, 1
        return np.asarray(np.degrees(np.unwrap(turned)) - 45.0)

    return magnitude, phase


def _way(strengths: FloatArray, x: FloatArray) -> FloatArray:
    lags = gammainc(np.arange(1.0, len(strengths) + 1.0)[:, None], np.maximum(x, 0.0))
    return np.asarray(strengths @ lags)


def dynamics_in_words(form: EffectForm, values: Sequence[float]) -> str:
    """Describe the speed of the step response, and the reduced model; "" if unknown."""
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
    """Return the one or two time constants of a reduced model, the shorter one first.

    The result is empty if the model needs more time constants, or if it would oscillate.
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
