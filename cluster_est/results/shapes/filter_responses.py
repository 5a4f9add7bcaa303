"""Step and frequency responses of free filters, and the few numbers that say the same.

A free filter has n equal lags in series, of which it adds k_i z_i. After a step of 1 of its
argument, lag i is at the regularised incomplete gamma function P(i, t / tau). At a frequency f it
multiplies a sine by a power of the transfer function of a lag:

    c(t) = d + sum k_i P(i, t / tau)        H(f) = d + sum k_i (1 + 2 pi j f tau)^-i

d is what passes at once. A balanced truncation (B. C. Moore, IEEE Trans. Automatic Control 26
(1981) 17-32, doi:10.1109/TAC.1981.1102568) says whether one or two time constants do nearly the
same.
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
"""Time constants behind those of its order after which a filter is drawn to be settled."""
PART = 1.0 - np.exp(-1.0)
"""Of its way: what a single lag does within its time constant."""
NO_WAY = 0.05
"""Share of its largest deflection below which a filter comes back to where it was."""
DECADE = 10.0
"""How far below and above the corner frequency of its lags the frequency response is drawn."""
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


def shown_frequencies(
    form: EffectForm, values: FloatArray, experiments: Sequence[Experiment]
) -> tuple[float, float]:
    """Return the range in Hz to draw: around the corner frequency, as far as the data reach.

    Data reach from one period in the longest record up to the Nyquist frequency.
    """
    corner = 0.5 / (np.pi * filter_parts(form, values)[1])
    around = corner / DECADE, corner * DECADE
    first = 1.0 / max(e.stop - e.start for e in experiments)
    rates = (len(o.times) / (e.stop - e.start) for e in experiments for o in e.outputs)
    low, high = max(around[0], first), min(around[1], 0.5 * max(rates, default=np.inf))
    return (low, high) if low < high else around


Response = Callable[[FloatArray, FloatArray], FloatArray]
"""A response of a free filter over times or frequencies, and its coefficients.

At an input or output, in the place of the signal's own, what that becomes.
"""


def _at_once(form: EffectForm, strengths: FloatArray) -> float:
    total = float(strengths.sum())
    return {Law.EXCHANGE: -total, Law.SIGNAL_DYNAMICS: 1.0 - total}.get(form.law, 0.0)


def step_response(form: EffectForm) -> Response:
    """Return the response of a free filter to a step of 1 at 0, over times."""

    def response(t: FloatArray, values: FloatArray) -> FloatArray:
        strengths, tau = filter_parts(form, values)
        return np.asarray(_at_once(form, strengths) + _way(strengths, t / tau))

    return response


def bode_plot(form: EffectForm) -> tuple[Response, Response]:
    """Return the magnitude of a free filter in dB and its phase in degrees, over f in Hz.

    The phase is continuous in f.
    """

    def complex_gain(f: FloatArray, values: FloatArray) -> NDArray[np.complex128]:
        strengths, tau = filter_parts(form, values)
        lag = 1.0 / (1.0 + 2j * np.pi * f * tau)
        return np.asarray(_at_once(form, strengths) + np.polyval([*strengths[::-1], 0.0], lag))

    def magnitude(f: FloatArray, values: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.asarray(20.0 * np.log10(np.abs(complex_gain(f, values))))

    def phase(f: FloatArray, values: FloatArray) -> FloatArray:
        turned = np.angle(complex_gain(f, values) * np.exp(0.25j * np.pi))  # no cut at -1 and 1
        return np.asarray(np.degrees(np.unwrap(turned)) - 45.0)

    return magnitude, phase


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
