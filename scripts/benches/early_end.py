"""How much simulated time populations save by ending simulations early.

Each method runs with and without `early_end` on the embedded examples and, from `tanks` starts, on
the chain of tanks of the bench `expensive_simulations`, with a budget of `points`. The results must
be the same, bit for bit. What counts is the simulated time (not the wall clock's) that was saved,
over the whole.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cluster_est as ce
from benches import Row
from benches.common import EXAMPLES, example
from benches.expensive_simulations import made_problem, write_model
from cluster_est.methods import SEARCH_METHODS
from cluster_est.running.resources import TaskOrigin
from workers.messages import Outcome, Status

OPTIONS = {"points": 2000, "tanks": 2}
NAMES = ("de", "pso", "ga")
ENDED = re.compile(r"at t = (\S+) s")


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each problem and method."""
    problems = {name: example(name) for name in EXAMPLES}
    with tempfile.TemporaryDirectory() as folder:
        fmu = write_model(Path(folder))
        for seed in range(options.tanks):
            problems[f"chain of tanks, start {seed}"] = made_problem(fmu, seed)
        for title, problem in problems.items():
            for name in NAMES:
                whole, found = simulated(problem, name, options.points, early=False)
                part, again = simulated(problem, name, options.points, early=True)
                yield {"problem": title, "records": len(problem.indices("train")), "method": name,
                       "saved": 1.0 - part / whole, "the same result": found == again}  # fmt: skip


def simulated(problem: ce.Problem, name: str, points: int, *, early: bool) -> tuple[float, bytes]:
    """Return the simulated seconds of a search, and the bits of its best point."""
    seconds = 0.0

    def record(origin: TaskOrigin, outcome: Outcome) -> None:
        nonlocal seconds
        run = problem.experiments[origin.task.experiment]
        end = run.stop
        if outcome.status is Status.ENDED_EARLY:
            found = ENDED.search(outcome.message)
            assert found is not None, outcome.message
            end = float(found[1])
        seconds += end - run.start if origin.search == "train" else 0.0

    budget = ce.Resources(workers=1, budget=ce.Budget(evaluations=points))
    method = SEARCH_METHODS[name](early_end=early)  # type: ignore[call-arg]
    result = ce.fit(problem, method, budget, record=record)
    return seconds, result.solution.x.tobytes()
