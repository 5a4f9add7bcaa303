"""What the wrapper of an exported FMU costs: the same loop around it and around its original.

Prints the ratio of interleaved medians, original = 1::

    python scripts/bench_export.py RUN [--config CONFIG] [--repeats 25]

Both are simulated with the run's solver in cluster-est's own loop, at the run's estimates. Where
the run has effects, the original has them around it as in the run, and the exported FMU inside.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from cluster_est.export.repair import gather
from cluster_est.export.repaired_fmu.fmu import write_fmu
from cluster_est.export.repaired_model import RepairedModel
from workers.evaluate import Evaluator
from workers.messages import Model, Task
from workers.wire import TaskBatch

POINTS = 20


def loops(repair: RepairedModel, fmu: Path) -> tuple[Callable[[], None], Callable[[], None]]:
    """Two functions, each of which simulates the first experiment at many points."""
    problem = repair.problem
    experiment = problem.experiments[0]
    found = {f.name: f.value for f in repair.parameters}
    starts = {p.target: p.start for p in problem.parameters}
    values = [found.get(name, starts.get(name)) for name in problem.model.parameters]
    effects = tuple(effect.effect for effect in repair.effects)
    coefficients = [f.value for own in repair.coefficients for f in own]
    exported = replace(problem.model, name=fmu.name, archive=fmu.read_bytes())
    return (
        _loop(problem.model, experiment, [*values, *coefficients], effects),
        _loop(exported, experiment, values, ()),
    )


def _loop(model: Model, experiment, values, effects) -> Callable[[], None]:  # type: ignore[no-untyped-def]
    evaluator = Evaluator(model, (experiment,), "bench")
    tasks = [Task(i, 0, np.array(values), "residuals", effects) for i in range(POINTS)]
    batch = TaskBatch.of(tasks)

    def run() -> None:
        outcomes = evaluator.evaluate(batch)
        assert all(outcome.ok for outcome in outcomes), outcomes[0].message

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--repeats", type=int, default=25)
    options = parser.parse_args()
    repair = gather(options.run, options.config, None, allow_code=False)
    with tempfile.TemporaryDirectory() as folder:
        fmu = Path(folder) / "exported.fmu"
        write_fmu(repair, fmu)
        seconds: tuple[list[float], list[float]] = ([], [])
        pair = loops(repair, fmu)
        for run in pair:
            run()
        for _ in range(options.repeats):
            for run, taken in zip(pair, seconds, strict=True):
                begin = time.perf_counter()
                run()
                taken.append(time.perf_counter() - begin)
    original, exported = (float(np.median(taken)) for taken in seconds)
    print(f"{repair.problem.model.name}, {len(repair.effects)} effects: {exported / original:.3f}")


if __name__ == "__main__":
    main()
