"""A fit of 500 parameters to 40 experiments: memory, and what an iteration costs the coordinator.

    python scripts/bench_many_parameters.py [--parameters 500] [--experiments 40] [--samples 500]

Nothing is simulated: a formula takes the place of simulations, and its time is left out. Every
parameter acts on all experiments, so that the Jacobian is one dense array. The outputs are bumps
over time whose strengths are a curved function of the parameters, with 1 % of noise.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
from virtual_executor import VirtualExecutor

from cluster_est import Experiment, LeastSquares, Model, Output, Parameter, Problem, Solver
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.records import SearchIteration
from cluster_est.running.resources import one_blas_thread
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import assess
from workers.messages import FloatArray, Task

NOISE = 0.01


class Bumps:
    """Data of many experiments: each sees all bumps through a wave of its own."""

    def __init__(self, parameters: int, experiments: int, samples: int) -> None:
        generator = np.random.default_rng(0)
        self.times = np.linspace(0.0, 10.0, samples)
        places = np.linspace(0.0, 10.0, parameters)
        distance = self.times[:, None] - places
        bump = np.exp(-((distance * parameters / 40.0) ** 2))
        rates = generator.uniform(1.0, 20.0, parameters)
        phases = generator.uniform(0.0, 6.0, (experiments, parameters))
        self.bumps = [bump * np.cos(rates * self.times[:, None] + phase) for phase in phases]
        self.true = generator.normal(size=parameters)
        self.measured = [
            self.values(e, self.true) + NOISE * generator.normal(size=samples)
            for e in range(experiments)
        ]

    def values(self, experiment: int, x: FloatArray) -> FloatArray:
        """The sum of all bumps in one experiment."""
        return np.asarray(self.bumps[experiment] @ (x + 0.3 * np.sin(2.0 * x)))

    def residuals(self, task: Task) -> FloatArray:
        """What a worker would send."""
        return (self.measured[task.experiment] - self.values(task.experiment, task.values)) / NOISE

    def problem(self) -> Problem:
        """A start that is 10 % off."""
        parameters = []
        for i, true in enumerate(self.true.tolist()):
            start = true * (1.1 if i % 3 else 0.9)
            parameters.append(Parameter(f"p{i}", start))
        runs = [
            Experiment(f"e{e}", 0.0, 10.0, (), (Output("y", self.times, values, sigma=NOISE),))
            for e, values in enumerate(self.measured)
        ]
        names = tuple(p.name for p in parameters)
        model = Model("none", b"", "model_exchange", Solver("rk4"), names)
        return Problem(model, tuple(parameters), tuple(runs))


def main() -> None:
    """Fit, and print a line for each iteration."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parameters", type=int, default=500)
    parser.add_argument("--experiments", type=int, default=40)
    parser.add_argument("--samples", type=int, default=500)
    given = parser.parse_args()
    bumps = Bumps(given.parameters, given.experiments, given.samples)
    space = make_space(bumps.problem(), tuple(range(given.experiments)))
    executor = VirtualExecutor(
        bumps.residuals, lambda task, generator: 1.0, 64, clock=time.process_time
    )
    before = [0.0]

    def note(line: SearchIteration) -> None:
        print(
            f"iteration {line.progress.iteration}: cost {line.progress.cost:.6g}; the coordinator "
            f"worked {executor.coordinator - before[0]:.1f} s",
            flush=True,
        )
        before[0] = executor.coordinator

    with one_blas_thread():
        runner = Runner(executor, note=note)
        (solution,) = runner.run([SearchRequest("fit", LeastSquares(), space)])
        begin = time.process_time()
        found = assess(space, solution)
        took = time.process_time() - begin
    errors = np.array([each.std_error for each in found.intervals])
    far = np.abs(solution.x - bumps.true) / errors
    samples = given.experiments * given.samples
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"{solution.ending}: cost {solution.cost:.6g} of {samples} samples; rms distance from the "
        f"truth {np.sqrt(np.mean(far**2)):.2f} standard errors; {runner.simulations} simulations, "
        f"{1e6 * executor.coordinator / runner.simulations:.0f} us of the coordinator each; "
        f"intervals {took:.1f} s; at most {memory:.2f} GB"
    )


if __name__ == "__main__":
    main()
