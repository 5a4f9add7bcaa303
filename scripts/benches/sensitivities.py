"""What sensitivities save on a fit with ten parameters.

The test FMU `chain`, five states and ten rates, is fitted with difference columns and with
sensitivities carried along, by turns, by one worker; in `experiments` of so many `times`. A row has
the simulations and the median seconds of the searches over those with the usual differences.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from fmus.build import build

import cluster_est as ce
from benches import Row
from benches.common import searches_by_turns
from cluster_est.methods.differences import Differences
from workers.evaluate import Evaluator
from workers.messages import Model, Task
from workers.wire import TaskBatch

OPTIONS = {"rounds": 5, "times": 2001, "experiments": 4}
RATES = tuple(f"{kind}{i}" for kind in "ab" for i in range(1, 6))
TRUTH = np.array([1.0, 0.8, 0.6, 0.5, 0.4, 0.10, 0.15, 0.20, 0.25, 0.30])
STATES = ("x1", "x2", "x3", "x4", "x5")
WAYS: tuple[Differences, ...] = ("auto", "forward", "sensitivities")


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each way."""
    problem = chain_problem(options.times, options.experiments)

    def fit(way: Differences) -> ce.Result:
        return ce.fit(problem, ce.LeastSquares(differences=way), ce.Resources(workers=1))

    found = searches_by_turns({way: partial(fit, way) for way in WAYS}, options.rounds)
    for way, (seconds, result) in found.items():
        yield {"differences": way, "simulations": result.simulated,
               "iterations": result.solution.iterations, "cost": result.solution.cost,
               "of the seconds of auto": seconds / found["auto"][0]}  # fmt: skip


def chain_problem(times: int, experiments: int) -> ce.Problem:
    """Noisy records of the chain under square waves of different lengths."""
    with tempfile.TemporaryDirectory() as folder:
        archive = build("chain", 2, Path(folder)).read_bytes()
    model = Model("chain.fmu", archive, "model_exchange", ce.Solver("dormand_prince"), RATES)
    grid, chance = np.linspace(0.0, 20.0, times), np.random.default_rng(1)
    runs = []
    for number in range(experiments):
        wave = 1.0 + np.sign(np.sin(2.0 * np.pi * grid / (4.0 + number)))
        given = ce.Input("u", grid, wave, "hold")
        blank = tuple(ce.Output(name, grid, 0.0 * grid, 0.01) for name in STATES)
        run = ce.Experiment(f"run{number}", 0.0, 20.0, (given,), blank)
        evaluator = Evaluator(model, (run,), "truth")
        (outcome,) = evaluator.evaluate(TaskBatch.of([Task(0, 0, TRUTH)]))
        evaluator.close()
        assert outcome.residuals is not None
        exact = np.split(-0.01 * outcome.residuals, len(STATES))
        noisy = (y + 0.01 * chance.standard_normal(times) for y in exact)
        pairs = zip(STATES, noisy, strict=True)
        outputs = tuple(ce.Output(name, grid, y, 0.01) for name, y in pairs)
        runs.append(ce.Experiment(run.id, 0.0, 20.0, (given,), outputs))
    starts = zip(RATES, TRUTH * np.linspace(0.6, 1.6, 10), strict=True)
    parameters = tuple(ce.Parameter(n, v, bounds=(1e-3, 5.0)) for n, v in starts)
    return ce.Problem(model, parameters, tuple(runs))
