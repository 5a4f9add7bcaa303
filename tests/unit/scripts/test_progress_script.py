"""The time left of a run whose budget ends it, on a virtual clock."""

import math

import pytest
from benches.progress import CASES, Case, run

from cluster_est.methods import SEARCH_METHODS

WITHIN = 1.5


@pytest.mark.parametrize(
    "case",
    [
        Case(SEARCH_METHODS["pattern_search"](), budget=60),
        pytest.param(Case(SEARCH_METHODS["de"](), budget=200, workers=20), marks=pytest.mark.slow),
        pytest.param(Case(SEARCH_METHODS["least_squares"](), 3, 100), marks=pytest.mark.slow),
    ],
    ids=lambda case: case.method.name,
)
@pytest.mark.parametrize("spread", [0.0, pytest.param(0.5, marks=pytest.mark.slow)])
def test_the_time_until_a_budget_ends_is_right_after_a_tenth(case, spread):
    recorded = run(case, 60.0, spread)
    for share in (0.1, 0.25, 0.5):
        assert 1.0 / WITHIN < recorded.ratio(share) < WITHIN


def test_the_pace_is_that_of_the_iterations():
    # one worker, every simulation a minute, three records: the time of so many of them
    recorded = run(
        Case(SEARCH_METHODS["nelder_mead"](bounds="enforce"), budget=60, workers=1), 60.0, 0.0
    )
    known = [(t, n, pace) for t, n, pace in recorded.paces if n]
    assert known
    assert all(pace == pytest.approx(t / n) for t, n, pace in known)
    assert all(math.isnan(pace) for _, n, pace in recorded.paces if not n)


def test_nothing_is_said_of_a_search_that_converges():
    recorded = run(CASES["least_squares, converges"], 60.0, 0.3)
    *under_way, ended = recorded.left
    assert all(math.isnan(left) for left in under_way)
    assert ended == 0.0
