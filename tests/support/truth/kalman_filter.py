"""The Kalman filter of the textbooks, and exact discretisations of linear stochastic systems.

Nothing of the project is used.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]


def discrete(dynamics: Array, density: Array, step: float) -> tuple[Array, Array]:
    """The transition and the noise of a step, after C. F. Van Loan (1978)."""
    n = len(dynamics)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[n:, n:], block[:n, n:] = -dynamics, dynamics.T, density
    found = expm(block * step)
    transition = found[n:, n:].T
    return transition, transition @ found[:n, n:]


def pushed(dynamics: Array, by: Array, step: float) -> Array:
    """What an input of 1 that acts by `by` adds to the state in a step."""
    n = len(dynamics)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = dynamics, by
    return np.asarray(expm(whole * step)[:n, n])


class Filter:
    """A Kalman filter: `correct` by one measured state at a time, then `carry` to the next time."""

    def __init__(self, state: Array) -> None:
        self.state = np.array(state, np.float64)
        self.covariance = np.zeros((len(state), len(state)))
        self.errors: dict[int, list[tuple[float, float]]] = {}

    def correct(self, index: int, value: float, sigma: float) -> None:
        """Take a measured value of a state in; its error and relative variance are kept."""
        error = value - self.state[index]
        spread = self.covariance[index, index] + sigma**2
        gain = self.covariance[:, index] / spread
        self.state = self.state + gain * error
        self.covariance = self.covariance - np.outer(gain, gain) * spread
        kept = self.errors.setdefault(index, [])
        kept.append((error / sigma, spread / sigma**2))

    def carry(self, move: Callable[[Array], Array], transition: Array, noise: Array) -> None:
        """Go to the next time."""
        self.state = move(self.state)
        self.covariance = transition @ self.covariance @ transition.T + noise

    def standardised(self, indices: Sequence[int]) -> Array:
        """Errors over their spreads, so long that their squares are -2 log likelihood."""
        both = np.concatenate([np.array(self.errors[i]) for i in indices])
        plain = both[:, 0] / np.sqrt(both[:, 1])
        wanted = np.sum(plain**2) + np.sum(np.log(both[:, 1]))
        return np.asarray(plain * np.sqrt(wanted / np.sum(plain**2)))


def runge_kutta(rate: Callable[[Array], Array], state: Array, step: float, parts: int) -> Array:
    """The classic method over a step, in equal parts."""
    h = step / parts
    for _ in range(parts):
        one = rate(state)
        two = rate(state + 0.5 * h * one)
        three = rate(state + 0.5 * h * two)
        four = rate(state + h * three)
        state = state + h / 6.0 * (one + 2.0 * two + 2.0 * three + four)
    return state
