"""What sensitivities save on a fit with ten parameters.

    python scripts/bench_sensitivities.py [--rounds 5] [--times 2001] [--experiments 4]

The test FMU `chain`, five states and ten rates, is fitted with difference columns and with
sensitivities carried along, by turns, by one worker. Printed are the simulations of both, and the
median seconds of the searches with sensitivities over those with differences.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from fmus.build import build

import cluster_est as ce
from cluster_est.fit import fit
from cluster_est.methods.differences import Differences
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.results.result import Result
from cluster_est.running.resources import Resources
from workers.evaluate import Evaluator
from workers.messages import Model, Task
from workers.wire import TaskBatch

RATES = tuple(f"{kind}{i}" for kind in "ab" for i in range(1, 6))
TRUTH = np.array([1.0, 0.8, 0.6, 0.5, 0.4, 0.10, 0.15, 0.20, 0.25, 0.30])
STATES = ("x1", "x2", "x3", "x4", "x5")
WAYS: tuple[Differences, ...] = ("auto", "forward", "sensitivities")


def main() -> None:
    """Fit by turns and print a line for each way."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--times", type=int, default=2001)
    parser.add_argument("--experiments", type=int, default=4)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        archive = build("chain", 2, Path(folder)).read_bytes()
    problem = make_problem(archive, options.times, options.experiments)
    seconds: dict[str, list[float]] = {way: [] for way in WAYS}
    found: dict[str, Result] = {}
    for turn in range(options.rounds + 1):
        for way in WAYS:
            method = LeastSquares(differences=way)
            found[way] = fit(problem, method, Resources(workers=1))
            if turn > 0:  # the first compiles
                seconds[way].append(found[way].search_seconds)
    usual = statistics.median(seconds["auto"])
    for each, result in found.items():
        solution = result.solution
        print(
            f"{each}: {result.simulated} simulations, {solution.iterations} iterations, "
            f"cost {solution.cost:.9g}, {statistics.median(seconds[each]) / usual:.2f} of the "
            f"seconds of auto {solution.message}"
        )


def make_problem(archive: bytes, times: int, experiments: int) -> ce.Problem:
    """Noisy records of the chain under square waves of different lengths."""
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
    factors = np.linspace(0.6, 1.6, 10)
    starts = zip(RATES, TRUTH * factors, strict=True)
    parameters = tuple(ce.Parameter(n, v, lower=1e-3, upper=5.0) for n, v in starts)
    return ce.Problem(model, parameters, tuple(runs))


if __name__ == "__main__":
    main()
