"""The test FMU `counts_instances`: its records, x' = -k x with x(0) = 1, and what it has counted.

It counts for itself, with a lock of its own and what the kernel says of processes: nothing of the
project is used. The truth of the records is exp(-k t), by hand.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cluster_est import Experiment, Model, Output, Parameter, Problem, Solver
from cluster_est.executors import Executor
from workers.messages import Outcome, Task

VARIABLE = "INSTANCES_COUNTED_IN"
RATE = 1.3
TIMES = np.linspace(0.0, 2.0, 41)
RECORDS = "abcd"


@dataclass(frozen=True)
class CountedInstances:
    """The instances since a folder was emptied."""

    folder: Path

    def forget(self) -> None:
        """Count from here; instances that are still there are no longer known."""
        for file in self.folder.iterdir():
            file.unlink()

    @property
    def made(self) -> int:
        """How many there have been, one after the other or at once."""
        return len(self._alive())

    @property
    def most(self) -> int:
        """The largest number that there was at once."""
        return max(self._alive())

    @property
    def processes(self) -> set[int]:
        """Those in which there was one."""
        return {int(words[1]) for words in self._lines() if words[0] == "MADE"}

    def _alive(self) -> list[int]:
        """How many there were with each, when it was made."""
        return [int(words[2]) for words in self._lines() if words[0] == "MADE"]

    def _lines(self) -> list[list[str]]:
        text = (self.folder / "log").read_text(encoding="ascii")
        return [line.split() for line in text.splitlines()]


def decay_problem(fmu: Path, solver: str = "dormand_prince", upper: float = 3.0) -> Problem:
    """Four records without noise."""
    chosen = Solver(solver)  # type: ignore[arg-type]
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", chosen, ("k",))
    output = Output("y", TIMES, np.exp(-RATE * TIMES))
    runs = tuple(Experiment(name, 0.0, 2.0, (), (output,)) for name in RECORDS)
    return Problem(model, (Parameter("k", 0.7, (0.01, upper)),), runs)


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
