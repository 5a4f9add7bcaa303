import numpy as np
import pytest

from cluster_est.statistics.choice_shares import LinearFit, choice_shares

PIECES = np.repeat(np.arange(12), 15)
OUTPUTS = np.tile(np.repeat([0, 1], [10, 5]), 12)
N = len(PIECES)


def fitted(columns, values):
    """The model of some columns at its least squares."""
    solution, *_ = np.linalg.lstsq(columns, values, rcond=None)
    return LinearFit(values - columns @ solution, -columns)


def refitted_shares(models, values, draws, seed):
    """The same by drawing rows and refitting, as a textbook has it."""
    generator = np.random.default_rng(seed)
    chosen = np.zeros(len(models))
    for _ in range(draws):
        drawn = generator.integers(12, size=12)
        rows = np.concatenate([np.flatnonzero(piece == PIECES) for piece in drawn])
        criteria = []
        for columns in models:
            solution, *_ = np.linalg.lstsq(columns[rows], values[rows], rcond=None)
            left = (values[rows] - columns[rows] @ solution) ** 2
            parts = [left[OUTPUTS[rows] == output] for output in (0, 1)]
            deviance = sum(len(part) * np.log(part.mean()) for part in parts)
            criteria.append(deviance + columns.shape[1] * np.log(len(rows)))
        chosen[np.argmin(criteria)] += 1
    return chosen / draws


def test_shares_are_those_of_models_that_are_refitted() -> None:
    generator = np.random.default_rng(1)
    first = generator.standard_normal(N)
    second = 0.97 * first + 0.25 * generator.standard_normal(N)
    common = generator.standard_normal(N)
    noise = np.where(OUTPUTS == 0, 1.0, 3.0) * generator.standard_normal(N)
    values = common + 1.5 * first + noise
    models = [
        np.column_stack([common]),
        np.column_stack([common, first]),
        np.column_stack([common, second]),
        np.column_stack([common, first, second]),
    ]
    fits = [fitted(columns, values) for columns in models]
    found = choice_shares(fits, PIECES, OUTPUTS, 400, np.random.default_rng(2))
    expected = refitted_shares(models, values, 400, 2)
    assert found == pytest.approx(expected, abs=0.01)
    assert 0.02 < found[1] < 0.98  # the data leave it open


def test_a_model_that_costs_more_is_chosen_less_and_equal_ones_not_at_all() -> None:
    generator = np.random.default_rng(3)
    column = generator.standard_normal((N, 1))
    values = 0.35 * column[:, 0] + generator.standard_normal(N)
    nothing = LinearFit(values, np.zeros((N, 0)))
    one = fitted(column, values)
    pair = [nothing, one]
    cheap = choice_shares(pair, PIECES, OUTPUTS, 200, np.random.default_rng(0))
    expensive = LinearFit(one.residuals, one.jacobian, 20.0)
    priced = choice_shares([nothing, expensive], PIECES, OUTPUTS, 200, np.random.default_rng(0))
    assert priced[1] < cheap[1]
    twice = choice_shares([one, one, nothing], PIECES, OUTPUTS, 200, np.random.default_rng(0))
    assert twice[1] == 0.0
    assert twice.sum() == pytest.approx(1.0)


def test_unknowns_of_a_piece_that_is_not_drawn() -> None:
    """An initial state of one experiment has no column in the others."""
    generator = np.random.default_rng(4)
    columns = np.zeros((N, 13))
    columns[np.arange(N), PIECES] = 1.0
    columns[:, 12] = generator.standard_normal(N)
    values = columns[:, 12] + generator.standard_normal(N)
    fits = [fitted(columns, values), fitted(columns[:, :12], values)]
    found = choice_shares(fits, PIECES, OUTPUTS, 100, np.random.default_rng(5))
    assert found[0] > 0.95
