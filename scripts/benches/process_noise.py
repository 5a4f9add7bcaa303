"""Prediction errors beside output errors, on a spring under an Ornstein-Uhlenbeck force.

A mass on a spring is driven by a known force and, besides, by an unknown one that is an
Ornstein-Uhlenbeck process. The data are exact samples of that linear stochastic system (its
discretisation by matrix exponentials, no simulation by the project). Fitted are mass, stiffness and
damping, once with the effect `coloured_noise` at the force, whose strength and time constant are
estimated too, and once without. Rows have the shares of estimates within one standard error and of
95 % intervals that hold the truth, and root mean square errors. What comes out are counts.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from scipy.linalg import expm

import cluster_est as ce
from benches import Row
from benches.common import MODELS, Array

OPTIONS = {"repetitions": 200}
FMU = MODELS / "mass_spring_damper.fmu"
TRUTH = {"m": 1.2, "k": 30.0, "c": 0.6}
NOISE = {"wind.q": 3.0, "wind.tau": 0.4}
SIGMA, STEP, SAMPLES, RECORDS = 0.01, 0.02, 400, 2


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each parameter and way."""
    for noise in (True, False):
        found: dict[str, list[tuple[float, float, bool]]] = defaultdict(list)
        failed = 0
        for seed in range(options.repetitions):
            result = ce.fit(made_problem(seed, noise=noise))
            failed += not result.success
            for each in result.estimates:
                true = (TRUTH | NOISE)[each.label]
                holds = each.lower95 <= true <= each.upper95
                found[each.label].append((each.value - true, each.std_error, holds))
        for label, every in found.items():
            error, spread, held = np.array(every, np.float64).T
            yield {
                "way": "prediction errors" if noise else "output errors",
                "parameter": label,
                "within one error": float(np.mean(np.abs(error) <= spread)),
                "intervals hold": float(np.mean(held)),
                "rms error": float(np.sqrt(np.mean(error**2))),
                "mean error": float(np.mean(error)),
                "did not converge": failed,
            }


def record(generator: np.random.Generator, force: Array) -> Array:
    """Positions at the times of a force that is held between them, with measurement noise."""
    m, k, c, q, tau = *TRUTH.values(), *NOISE.values()
    dynamics = np.array([[0.0, 1.0, 0.0], [-k / m, -c / m, 1.0 / m], [0.0, 0.0, -1.0 / tau]])
    whole = np.zeros((4, 4))
    whole[:3, :3], whole[1, 3] = dynamics, 1.0 / m
    step = expm(whole * STEP)
    # C. F. Van Loan, IEEE Trans. Autom. Control 23 (1978) 395-404, doi:10.1109/TAC.1978.1101743
    block = np.zeros((6, 6))
    block[:3, :3], block[3:, 3:], block[2, 5] = -dynamics, dynamics.T, q * q
    found = expm(block * STEP)
    root = np.linalg.cholesky(found[3:, 3:].T @ found[:3, 3:] + 1e-20 * np.eye(3))
    state = np.array([0.1, 0.0, q * np.sqrt(0.5 * tau) * generator.normal()])
    positions = []
    for pushed in force:
        positions.append(state[0])
        state = step[:3, :3] @ state + step[:3, 3] * pushed + root @ generator.normal(size=3)
    return np.array(positions) + SIGMA * generator.normal(size=len(force))


def made_problem(seed: int, *, noise: bool) -> ce.Problem:
    """The records of one repetition."""
    generator = np.random.default_rng(seed)
    times = np.asarray(STEP * np.arange(SAMPLES), np.float64)
    runs = []
    for i in range(RECORDS):
        force = 3.0 * np.sin(3.8 * times) + 2.0 * np.sign(np.sin(1.9 * times + i))
        output = ce.Output("y", times, record(generator, force), sigma=SIGMA)
        driven = ce.Input("F", times, force, "hold")
        runs.append(ce.Experiment(f"r{i}", 0.0, times[-1], (driven,), (output,), (("x", 0.1),)))
    parameters = [
        ce.Parameter("m", 1.0, (0.1, 10.0)),
        ce.Parameter("k", 25.0, (1.0, 200.0)),
        ce.Parameter("c", 0.4, (0.0, 10.0)),
    ]
    model = ce.read_model(FMU)
    effects: tuple[ce.Effect, ...] = ()
    if noise:
        effects = (ce.Effect("wind", "input F", "coloured_noise"),)
        parameters.append(ce.Parameter("wind.q", 1.0, (0.01, 100.0), "log"))
        parameters.append(ce.Parameter("wind.tau", 0.2, (0.01, 10.0), "log"))
    return ce.Problem(model, tuple(parameters), tuple(runs), effects=effects)
