import numpy as np
import pytest
from support.truth.stacked_noise import coloured, late

from cluster_est.statistics.dependence import NO_DEPENDENCE, dependence, periodic_share

NULLS = {
    "oscillating": lambda rng, n: coloured(rng, n, 1.95, -0.97),
    "random walk": lambda rng, n: np.cumsum(rng.standard_normal(n)),
}
MORE_NULLS = {
    "slow, with white noise": lambda rng, n: coloured(rng, n, 0.98) + rng.standard_normal(n),
    "first order": lambda rng, n: coloured(rng, n, 0.9),
    "slow": lambda rng, n: coloured(rng, n, 0.99),
    "smooth": lambda rng, n: late(coloured(rng, n, 0.98), 20.0) + 0.1 * rng.standard_normal(n),
    "trend": lambda rng, n: np.linspace(0.0, 20.0 * rng.normal(), n) + coloured(rng, n, 0.9),
}


@pytest.mark.parametrize(
    "make",
    [
        *(pytest.param(make, id=name) for name, make in NULLS.items()),
        *(pytest.param(m, id=name, marks=pytest.mark.slow) for name, m in MORE_NULLS.items()),
    ],
)
def test_what_has_nothing_to_do_with_it_is_rarely_named(make):
    """50 draws of two series of one colour: at 1 %, more than 3 have a chance of 0.2 %."""
    rng = np.random.default_rng(7)
    draws = [[(make(rng, 400), make(rng, 400)) for _ in range(2)] for _ in range(50)]
    found = np.array([dependence(records).p for records in draws])
    assert np.count_nonzero(found <= 0.01) <= 3
    assert found.min() > 1e-6


@pytest.mark.parametrize("lag", [0.0, 10.0, 50.0])
def test_a_cause_is_found_through_the_lag_of_a_model(lag):
    rng = np.random.default_rng(3)
    records = []
    for _ in range(3):
        x = coloured(rng, 800, 0.99)
        y = late(x, lag) if lag else x
        records.append((3.0 * y / y.std() + rng.standard_normal(800) + 5.0, 1e4 * x - 2e5))
    found = dependence(records)
    assert found.p < 1e-8
    assert found.share > 0.7


@pytest.mark.parametrize(
    ("seed", "first"),
    [(9, None), (11, {}), (11, {"u": np.full(500, 2.0)})],
    ids=["moves", "absent in a record", "still in a record"],
)
def test_what_an_input_moves_is_no_evidence_where_the_input_is_known(seed, first):
    """Residual and column both follow the input, and have nothing to do with each other else."""
    rng = np.random.default_rng(seed)
    records, inputs = [], []
    for i in range(3):
        moves = i > 0 or first is None
        u = coloured(rng, 500, 0.95) if moves else np.zeros(500)
        y = late(u, 12.0) + 0.05 * coloured(rng, 500, 0.8)
        records.append((y, late(u, 4.0) + 0.05 * coloured(rng, 500, 0.8)))
        inputs.append({"u": u} if moves else first)
    assert dependence(records).p < 1e-6
    assert dependence(records, inputs).p > 1e-3


def test_a_cause_is_found_beside_a_known_input():
    rng = np.random.default_rng(10)
    records, inputs = [], []
    for _ in range(2):
        u, x = coloured(rng, 500, 0.95), coloured(rng, 500, 0.97)
        records.append((late(u, 12.0) + late(x, 8.0) + 0.1 * rng.standard_normal(500), x))
        inputs.append({"u": u})
    assert dependence(records, inputs).p < 1e-6


def test_two_decays_from_one_start_are_no_evidence():
    rng = np.random.default_rng(12)
    t = np.arange(400.0)
    draws = [
        [
            (3.0 * np.exp(-t / 80.0) + 0.05 * rng.standard_normal(400),
             np.exp(-t / 50.0) + 0.02 * rng.standard_normal(400))
            for _ in range(2)
        ]
        for _ in range(20)
    ]  # fmt: skip
    assert sum(dependence(records).p <= 0.01 for records in draws) <= 2


def test_the_size_of_a_column_changes_nothing():
    rng = np.random.default_rng(5)
    x = coloured(rng, 500, 0.95)
    y = x + coloured(rng, 500, 0.9)
    one, other = dependence([(y, x)]), dependence([(1e-6 * y, 1e5 * x + 3e6)])
    assert other.p == pytest.approx(one.p, rel=1e-4)
    assert other.share == pytest.approx(one.share, rel=1e-6)


@pytest.mark.parametrize(
    "records",
    [
        [],
        [(np.zeros(300), np.arange(300.0))],
        [(np.random.default_rng(0).standard_normal(300), np.ones(300))],
        [(np.ones(20), np.arange(20.0))],
    ],
    ids=["none", "no residual", "constant", "short"],
)
def test_too_little_says_nothing(records):
    assert dependence(records) == NO_DEPENDENCE


def test_the_share_of_a_period():
    t = np.arange(0.0, 6.0, 0.01)
    noise = 0.1 * np.random.default_rng(2).standard_normal(len(t))
    wave = np.sin(2.0 * np.pi * t + 1.0) + 0.5 * t + noise
    assert periodic_share(wave, t, 1.0) > 0.9
    assert periodic_share(wave, t, 0.7) < 0.1
    assert periodic_share(np.ones(len(t)), t, 1.0) == 0.0
