import numpy as np
import pytest
from scipy.stats import multivariate_normal

from cluster_est.experiment_design.criteria import evidence_table, expected_probabilities
from cluster_est.experiment_design.predicted_outputs import PredictedExperiment

SAMPLES = 12


def made(seed, unknowns, offset=0.0):
    generator = np.random.default_rng(seed)
    jacobian = generator.standard_normal((SAMPLES, unknowns))
    root = generator.standard_normal((unknowns, unknowns)) + 2.0 * np.eye(unknowns)
    outputs = offset + generator.standard_normal(SAMPLES)
    return PredictedExperiment(outputs, jacobian, root @ root.T)


def refitted(each, outputs):
    """Squares that a linear model leaves of outputs and of what was known of it, refitted."""
    root = np.linalg.cholesky(each.information).T
    tall = np.vstack([each.jacobian, root])
    left = np.column_stack([outputs - each.outputs, np.zeros((len(outputs), len(root)))]).T
    return np.sum((left - tall @ np.linalg.lstsq(tall, left)[0]) ** 2, axis=0)


def test_it_is_what_a_rival_falls_behind_when_both_are_fitted_again():
    pair = made(1, 2), made(2, 3, offset=0.5)
    table = evidence_table(pair)
    for i, j in ((0, 1), (1, 0)):
        own = pair[i]
        spread = own.jacobian @ np.linalg.inv(own.information) @ own.jacobian.T
        draws = multivariate_normal(own.outputs, np.eye(SAMPLES) + spread).rvs(
            100_000, random_state=7
        )
        behind = 0.5 * (refitted(pair[j], draws) - refitted(own, draws))
        error = behind.std() / np.sqrt(len(draws))
        assert table[i, j] == pytest.approx(behind.mean(), abs=4.0 * error)


def test_the_unit_of_an_unknown_does_not_matter():
    one, other = made(1, 2), made(2, 3)
    scale = np.array([10.0, 0.01])
    scaled = PredictedExperiment(
        one.outputs, one.jacobian * scale, one.information * np.outer(scale, scale)
    )
    np.testing.assert_allclose(
        evidence_table([scaled, other]), evidence_table([one, other]), rtol=1e-8
    )


def test_probabilities_without_evidence_are_those_of_before():
    weights = np.array([0.5, 0.3, 0.2])
    np.testing.assert_allclose(expected_probabilities(np.zeros((3, 3)), weights), weights)


def test_overwhelming_evidence_leaves_one_model():
    evidence = np.full((3, 3), 1e6)
    found = expected_probabilities(evidence, np.array([0.5, 0.3, 0.2]))
    np.testing.assert_allclose(found, 1.0)
