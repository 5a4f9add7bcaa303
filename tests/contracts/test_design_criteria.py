"""What every criterion of a design must do. A new one is picked up by its line."""

from types import SimpleNamespace

import numpy as np
import pytest

from cluster_est.experiment_design.criteria import CRITERIA
from cluster_est.experiment_design.models import PredictedOutput
from cluster_est.experiment_design.predicted_outputs import PredictedExperiment

EVERY = pytest.mark.parametrize("name", CRITERIA)
LABELS = ("a", "b")
TARGETS = tuple(
    PredictedOutput("planned", name, "m", np.random.default_rng(8 + i).standard_normal((25, 2)))
    for i, name in enumerate(("y", "z"))
)


def model(weight=0.5):
    """A model of two unknowns, known to 1 and 2."""
    information = np.diag([1.0, 0.25])
    known = {"labels": LABELS, "information": information, "targets": TARGETS}
    known |= {"covariance": np.linalg.inv(information)}
    return SimpleNamespace(model=SimpleNamespace(weight=weight), **known)


def predicted(scale, offset, seed=1, samples=40):
    """The outputs of a model that is linear in its unknowns."""
    jacobian = np.random.default_rng(seed).standard_normal((samples, 2))
    outputs = scale * (jacobian @ [1.0, -0.5] + offset * np.linspace(0.0, 1.0, samples) ** 2)
    return PredictedExperiment(outputs, scale * jacobian, np.diag([1.0, 0.25]), LABELS)


def value(name, *experiments):
    models = [model() for _ in experiments]
    return CRITERIA[name].value(models, experiments, LABELS)


@EVERY
def test_it_is_known_by_its_own_name(name):
    assert CRITERIA[name].name == name
    assert CRITERIA[name].called


@EVERY
def test_an_experiment_that_shows_more_is_worth_more(name):
    worth = [value(name, predicted(s, 0.0), predicted(s, 5.0)) for s in (0.1, 0.3, 1.0)]
    assert worth == sorted(worth)
    assert worth[-1] > worth[0]


@EVERY
def test_an_experiment_that_shows_nothing_is_worth_the_least(name):
    nothing = value(name, predicted(0.0, 0.0), predicted(0.0, 0.0))
    assert nothing == pytest.approx(0.5 if CRITERIA[name].compares else 0.0, abs=1e-9)
    assert value(name, predicted(1.0, 0.0), predicted(1.0, 3.0)) > nothing


@EVERY
def test_the_order_of_the_samples_does_not_matter(name):
    order = np.random.default_rng(5).permutation(40)

    def shuffled(each):
        return PredictedExperiment(
            each.outputs[order], each.jacobian[order], each.information, each.labels
        )

    pair = predicted(1.0, 0.0), predicted(1.0, 2.0)
    assert value(name, *map(shuffled, pair)) == pytest.approx(value(name, *pair), rel=1e-9)
