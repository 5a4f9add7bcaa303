from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.problems.seen_springs import with_outputs
from support.problems.springs import spring_problem
from support.truth.exact_linear import position

from cluster_est import LeastSquares, Solver, fit
from cluster_est.methods import SEARCH_METHODS

SCIPY = SEARCH_METHODS["scipy_least_squares"]


@pytest.mark.parametrize(
    ("interface", "solver"),
    [
        ("model_exchange", None),
        ("model_exchange", Solver("rk4", step=0.002)),
        ("model_exchange", Solver("dormand_prince")),
        ("co_simulation", Solver("fmu", step=0.002)),
    ],
)
def test_every_parameter_returns_without_noise(interface, solver):
    truth = spring_problem(3, solver=solver, interface=interface)
    result = fit(truth.problem)
    assert result.success
    assert result.diagnostics.findings == ()  # of what is left, which is no noise
    for label, value in truth.values.items():
        assert result.x[label] == pytest.approx(value, rel=1e-6)


def scipy_cost(truth, part=None):
    """The minimum that SciPy finds with exact simulations, from the same start.

    Where `part` is given the noise has 0.002 and that part of what was measured.
    """
    runs = truth.problem.experiments
    outputs, forces = [e.outputs[0] for e in runs], [e.inputs[0] for e in runs]

    def sigma(values):
        return 1.0 if part is None else np.sqrt(0.002**2 + (part * values) ** 2)

    def residuals(x):
        m, log_k, c, *starts = x
        return np.concatenate(
            [
                (y.values - position(y.times, f.values, m, np.exp(log_k), c, x0)) / sigma(y.values)
                for y, f, x0 in zip(outputs, forces, starts, strict=True)
            ]
        )

    start = np.array([1.0, np.log(20.0), 1.0, *np.zeros(len(runs))])
    return 2.0 * least_squares(residuals, start, "3-point", xtol=1e-14, ftol=1e-14, gtol=1e-14).cost


@pytest.mark.parametrize(
    "method",
    [
        LeastSquares(),
        LeastSquares(differences="central"),
        LeastSquares(trials=1),
        LeastSquares(trials=2),
        SCIPY(),
        *(
            pytest.param(slow, marks=pytest.mark.slow)
            for slow in (
                LeastSquares(trials=7),
                LeastSquares(differences="forward"),
                SCIPY(algorithm="dogbox"),
            )
        ),
    ],
    ids=repr,
)
def test_cost_with_noise_is_that_of_scipy(method):
    truth = spring_problem(3, noise=0.01)
    assert fit(truth.problem, method).cost == pytest.approx(scipy_cost(truth), rel=1e-9)


def test_noise_that_grows_with_the_signal():
    truth = spring_problem()
    generator = np.random.default_rng(5)

    def louder(output):
        noise = np.sqrt(0.002**2 + (0.2 * output.values) ** 2)
        measured = output.values + noise * generator.normal(size=len(noise))
        return replace(output, values=measured, sigma=0.002, relative_sigma=0.2)

    truth = replace(truth, problem=with_outputs(truth.problem, louder))
    result = fit(truth.problem)
    assert result.cost == pytest.approx(scipy_cost(truth, 0.2), rel=1e-8)
    for row, run in zip(result.errors, truth.problem.experiments, strict=True):
        (output,) = run.outputs
        assert row.normalised_after == pytest.approx(1.0, abs=0.25)
        assert row.rmse_after < 2.0 * np.sqrt(np.mean((0.2 * output.values) ** 2) + 0.002**2)
