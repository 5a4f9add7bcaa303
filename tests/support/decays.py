"""Records of x' = -k x, x(0) = 1, for the FMU that counts its instances: exp(-k t), by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_est import Experiment, Model, Output, Parameter, Problem, Solver
from cluster_est.executors import Executor
from workers.messages import Outcome, Task

RATE = 1.3
TIMES = np.linspace(0.0, 2.0, 41)
RECORDS = "abcd"


def decay_problem(fmu: Path, solver: str = "dormand_prince", upper: float = 3.0) -> Problem:
    """Four records without noise."""
    chosen = Solver(solver)  # type: ignore[arg-type]
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", chosen, ("k",))
    output = Output("y", TIMES, np.exp(-RATE * TIMES))
    runs = tuple(Experiment(name, 0.0, 2.0, (), (output,)) for name in RECORDS)
    return Problem(model, (Parameter("k", 0.7, 0.01, upper),), runs)


def write_decay(folder: Path, fmu: Path, noise: float = 0.0) -> Path:
    """The same as a config with its data."""
    generator = np.random.default_rng(0)
    text = "parameters.k = { start = 0.7, bounds = [0.01, 1.9] }\n"
    text += f'[model]\nfmu = "{fmu}"\n'
    for name in RECORDS:
        y = np.exp(-RATE * TIMES) + noise * generator.standard_normal(len(TIMES))
        rows = [f"{t!r},{v!r}" for t, v in zip(TIMES.tolist(), y.tolist(), strict=True)]
        (folder / f"{name}.csv").write_text("time,y\n" + "\n".join(rows) + "\n")
        text += f'[[experiments]]\nid = "{name}"\ndata = "{name}.csv"\ntime = "time"\n'
        text += 'outputs = { y = "y" }\n'
    path = folder / "config.toml"
    path.write_text(text, encoding="utf-8")
    return path


def answered(executor: Executor, rates: list[float], first: int = 0) -> list[Outcome]:
    """The outcomes of tasks of these rates, in their order."""
    tasks = [Task(first + i, i % len(RECORDS), np.array([rate])) for i, rate in enumerate(rates)]
    executor.submit(tasks)
    found: dict[int, Outcome] = {}
    while len(found) < len(tasks):
        found |= {outcome.task: outcome for outcome in executor.completed()}
    return [found[task.id] for task in tasks]


def check_decays(outcomes: list[Outcome], rates: list[float], error: float = 1e-6) -> None:
    """Compare those that succeeded with the solution by hand."""
    for outcome, rate in zip(outcomes, rates, strict=True):
        if outcome.ok:
            assert outcome.residuals is not None
            expected = np.exp(-RATE * TIMES) - np.exp(-rate * TIMES)
            assert np.allclose(outcome.residuals, expected, atol=error)
