"""Problems without derivatives: with jumps, with edges, with noise. Their minima are known.

Residuals are such that the sum of their squares is the function meant.
"""

import numpy as np
from support.problems.functions import FunctionProblem

# orthonormal rows that no axis is close to
MIXED = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]]) / 2.0
CENTRE = np.array([0.3, -0.7, 1.1, 0.4])
NOISE = 1e-3


def stairs(x):
    """Each residual grows with its distance from 0 and jumps by 0.1 four times a unit."""
    d = (x - CENTRE[:2]) @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    return d * np.array([1.0, 3.0]) + 0.1 * np.round(4.0 * d)


def quantised(x):
    """A bowl whose residuals are read from a display with few digits, as from a counter."""
    d = MIXED @ (x - CENTRE) * np.array([1.0, 2.0, 3.0, 4.0])
    return np.round(d, 2)


def edges(x):
    """The largest of four distances: every contour is a box that is turned against the axes."""
    d = MIXED @ (x - CENTRE) * np.array([1.0, 2.0, 3.0, 4.0])
    return np.sqrt(np.abs(d).max(keepdims=True))


def three_maxima(x):
    """Problem CB3 of Charalambous and Conn: the largest of three smooth functions; 2 at (1, 1)."""
    a, b = x
    three = a**4 + b**2, (2.0 - a) ** 2 + (2.0 - b) ** 2, 2.0 * np.exp(b - a)
    return np.sqrt(np.array([max(three)]))


def ripple(x):
    """A bowl with a ripple that is much finer than any useful step."""
    d = MIXED @ (x - CENTRE) * np.array([1.0, 2.0, 3.0, 4.0])
    return np.array([*d, np.sqrt(NOISE * (1.0 + np.sin(1e4 * np.add.reduce(d))))])


def noise(x):
    """A bowl with noise that is drawn anew for each x, but always the same for the same x."""
    d = MIXED @ (x - CENTRE) * np.array([1.0, 2.0, 3.0, 4.0])
    drawn = np.random.default_rng(np.frombuffer(x.tobytes(), np.uint32)).random()
    return np.array([*d, np.sqrt(NOISE * drawn)])


START = (1.0, 1.0, -1.0, 2.0)

ROUGH = [
    (FunctionProblem("stairs", stairs, (2.0, 1.0), 0.0), 1e-6),
    (FunctionProblem("quantised", quantised, START, 0.0), 1e-3),
    (FunctionProblem("edges", edges, START, 0.0), 1e-3),
    (FunctionProblem("three maxima", three_maxima, (2.0, 2.0), 2.0), 1e-3),
    (FunctionProblem("ripple", ripple, START, 0.0), 3.0 * NOISE),
    (FunctionProblem("noise", noise, START, 0.0), 3.0 * NOISE),
]
"""Problems, and how far above the minimum a method may end.

The fourth is from C. Charalambous, A. R. Conn, An efficient method to solve the minimax problem
directly, SIAM J. Numer. Anal. 15 (1978) 162-187, doi:10.1137/0715011.
"""
