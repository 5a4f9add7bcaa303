"""The units of parameters and outputs change nothing but the numbers.

A unit is a factor between what a method moves and what the model is given, on start and bounds too.
Offsets start at 0, where no number says how large they may be.
"""

import itertools

import numpy as np
import pytest
from support.problems.curves import Curves
from support.thinning import thinned

from cluster_est import Parameter
from cluster_est.methods import LeastSquares, NelderMead, PatternSearch, ScipyLeastSquares, Sqp
from cluster_est.problem.costs import COSTS
from cluster_est.running.search_state import SearchRequest
from cluster_est.running.sizes import with_sizes
from cluster_est.uncertainty.covariance.derivatives import examine

TIMES = np.linspace(0.0, 4.0, 41)
NOISE = 0.01 * np.random.default_rng(3).normal(size=len(TIMES))
METHODS = {
    "least_squares": LeastSquares(),
    "scipy": ScipyLeastSquares(),
    "sqp": Sqp(),
    "slsqp": Sqp(algorithm="slsqp"),
    "nelder_mead": NelderMead(xtol=1e-9, ftol=1e-14),
    "pattern_search": PatternSearch(),
}
FACTORS = (1e-15, 1e-12, 1e-6, 1e-3, 1e3, 1e6, 1e12, 1e15)
WIDE = (-np.inf, np.inf)


def fitted(method, cost="sse", unit=(1.0, 1.0, 1.0), output=1.0, bounds=WIDE, offset=0.3):
    """Fit gain, rate and offset of a decay; what is said of them, in the plain units.

    `bounds` are those of the offset, which starts at 0.
    """

    def decay(times, values, experiment):
        gain, rate, shift = values / np.array(unit)
        return output * (gain * np.exp(-rate * times) + shift)

    parameters = (
        Parameter("gain", 1.0 * unit[0], (0.0, np.inf)),
        Parameter("rate", 1.0 * unit[1], (0.01 * unit[1], 20.0 * unit[1])),
        Parameter("offset", 0.0, (bounds[0] * unit[2], bounds[1] * unit[2])),
    )
    measured = [output * (2.0 * np.exp(-0.7 * TIMES) + offset + NOISE)]
    curves = Curves(decay, parameters, TIMES, measured, cost=COSTS[cost]())
    runner = curves.runner()
    space = with_sizes(runner, curves.space())
    (solution,) = runner.run([SearchRequest("fit", method, space)])
    found = examine(runner, space, solution)
    errors = np.array([interval.std_error for interval in found.intervals]) / unit
    kinds = [(each.labels, each.kind) for each in found.directions]
    said = (solution.ending, kinds, [interval.at_bound for interval in found.intervals])
    return solution.x / unit, errors, said


def units(factor):
    """The same factor for one unknown or the other, or for the outputs."""
    return [
        ((factor, 1.0, 1.0), 1.0),
        ((1.0, factor, 1.0), 1.0),
        ((1.0, 1.0, factor), 1.0),
        ((1.0, 1.0, 1.0), factor),
        ((factor, 1.0, factor), factor),
        ((factor, 1.0 / factor, 1.0 / factor), 1.0),
    ]


PRODUCT = [
    (method, cost, factor, unit, output)
    for method, cost, factor in itertools.product(METHODS, ("sse", "likelihood", "huber"), FACTORS)
    for unit, output in units(factor)
    if cost == "sse" or (output == 1.0 and not (cost == "huber" and method == "scipy"))
    if not (method == "scipy" and cost != "sse")
]


@pytest.mark.parametrize(
    ("method", "cost", "factor", "unit", "output"),
    thinned(
        PRODUCT,
        lambda method, *_: method,
        lambda _, cost, *__: cost,
        lambda _, __, factor, unit, output: (factor, tuple(u != 1.0 for u in unit), output != 1.0),
    ),
)
def test_other_units_change_no_finding(method, cost, factor, unit, output):
    plain, plain_errors, plain_said = fitted(METHODS[method], cost)
    x, errors, said = fitted(METHODS[method], cost, unit, output)
    assert said == plain_said
    np.testing.assert_allclose(x, plain, rtol=0, atol=1e-3 * plain_errors.min())
    np.testing.assert_allclose(errors, plain_errors, rtol=1e-2)


@pytest.mark.parametrize("method", [name for name in METHODS if name != "least_squares"])
def test_powers_of_two_change_no_bit(method):
    """But for `least_squares`, whose steps come from a decomposition that turns the axes."""
    plain, *_ = fitted(METHODS[method])
    for unit in ((2.0**20, 2.0**-13, 2.0**9), (1.0, 1.0, 2.0**-40), (2.0**30, 1.0, 2.0**50)):
        np.testing.assert_array_equal(fitted(METHODS[method], unit=unit)[0], plain)


@pytest.mark.parametrize("bounds", [(-np.inf, 1e9), (0.0, 1e6), (0.0, np.inf), (-1e-3, 1e12)])
def test_wide_bounds_say_nothing_of_a_size(bounds):
    plain, plain_errors, plain_said = fitted(LeastSquares())
    x, errors, said = fitted(LeastSquares(), bounds=bounds)
    assert said == plain_said
    np.testing.assert_allclose(x, plain, rtol=0, atol=1e-3 * plain_errors.min())
    np.testing.assert_allclose(errors, plain_errors, rtol=1e-3)


@pytest.mark.parametrize(
    "factor", [1e-12, *(pytest.param(f, marks=pytest.mark.slow) for f in (1.0, 1e12))]
)
def test_a_bound_that_holds_is_named_in_any_unit(factor):
    x, _, said = fitted(LeastSquares(), unit=(1.0, 1.0, factor), bounds=(0.0, np.inf), offset=-0.3)
    assert x[2] == 0.0
    assert said[2] == ["", "", "lower"]
