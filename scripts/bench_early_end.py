"""How much simulated time populations save by ending simulations early.

    python scripts/bench_early_end.py [--points 2000] [--tanks 2]

Each method runs with and without `early_end` on the embedded examples and on the chain of tanks of
`bench_dear_simulations.py`, with a budget of points. The results must be the same, bit for bit.
Printed is the simulated time (not the wall clock's) that was saved, as a share of the whole.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path

from bench_dear_simulations import made_problem, write_model
from build_fmus import build

import cluster_est as ce
from cluster_est.config.build import build_problem
from cluster_est.config.reader import read_config
from cluster_est.methods import METHODS
from cluster_est.running.resources import TaskOrigin
from workers.messages import Outcome, Status

CONFIGS = Path(__file__).parents[1] / "configs"
EXAMPLES = ("mass_spring_damper", "mass_with_friction", "cascaded_tanks")
NAMES = ("de", "pso", "ga")
ENDED = re.compile(r"at t = (\S+) s")


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
    method = METHODS[name](early_end=early)  # type: ignore[call-arg]
    result = ce.fit(problem, method, budget, record=record)
    return seconds, result.solution.x.tobytes()


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=2000)
    parser.add_argument("--tanks", type=int, default=2, help="starts of the chain of tanks")
    given = parser.parse_args()
    problems = {
        name: build_problem(read_config(CONFIGS / f"{name}.toml"), CONFIGS) for name in EXAMPLES
    }
    with tempfile.TemporaryDirectory() as folder:
        fmu = build(write_model(Path(folder)), Path(folder))
        for seed in range(given.tanks):
            problems[f"chain of tanks, start {seed}"] = made_problem(fmu, seed)[0]
        for title, problem in problems.items():
            records = len(problem.indices("train"))
            for name in NAMES:
                whole, found = simulated(problem, name, given.points, early=False)
                part, again = simulated(problem, name, given.points, early=True)
                same = "the same" if found == again else "NOT THE SAME"
                print(
                    f"{title:28s} {records} records, {name:4s} saves "
                    f"{100.0 * (1.0 - part / whole):4.1f} % of the simulated time; result {same}"
                )


if __name__ == "__main__":
    main()
