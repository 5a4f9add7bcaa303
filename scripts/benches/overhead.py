"""What it costs to have simulations done elsewhere, by the time that one of them takes.

The same tasks go to one core of this process, to processes and to Ray workers by turns. A row has
the share of time in which each worker simulates at least, and how many times as many simulations a
second are done as on the one core: medians of the `rounds`, each with `seconds` of work for one
core. Executors alone are measured here; a fit adds what its coordinator needs for a task (the bench
`scaling`).
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from build_fmus import build

from benches import Row
from benches.common import ROOT
from cluster_est.executors import executor_class
from cluster_est.executors.executor import Executor
from cluster_est.running.resources import one_blas_thread
from workers.messages import Experiment, Model, Output, Solver, Task

OPTIONS = {"seconds": 4.0, "rounds": 3, "workers": 2}
MODEL = ROOT / "tests" / "fmus" / "lenient_models" / "misbehaves"
WANTED = (50e-6, 200e-6, 1e-3, 5e-3, 20e-3, 100e-3)
FIRST_STEP, END, SAMPLES = 1e-4, 2.0, 21
AT_ONCE = 400
"""Simulations in one request, where they are short."""


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each time of a simulation and each executor."""
    times = np.linspace(0.0, END, SAMPLES)
    experiments = (Experiment("e", 0.0, END, (), (Output("y", times, np.zeros(SAMPLES)),)),)
    with tempfile.TemporaryDirectory() as folder, one_blas_thread():
        archive = build(MODEL, Path(folder)).read_bytes()
        for wanted in WANTED:
            yield from compare(model(archive, wanted, experiments), experiments, wanted, options)


def model(archive: bytes, wanted: float, experiments: tuple[Experiment, ...]) -> Model:
    """The FMU with a step that makes a simulation take about so long."""

    def with_step(step: float) -> Model:
        parameters, solver = ("rate", "kind", "share", "leak"), Solver("rk4", step, max_steps=10**8)
        return Model("misbehaves.fmu", archive, "model_exchange", solver, parameters)

    with executor_class("local").open(with_step(FIRST_STEP), experiments, 1, None) as executor:
        measure(executor, 100)
        rate, _ = measure(executor, 200)
    return with_step(FIRST_STEP / (wanted * rate))


def compare(
    model: Model, experiments: tuple[Experiment, ...], wanted: float, options: argparse.Namespace
) -> Iterator[Row]:
    """Measure all executors by turns with simulations of one length."""
    counts = {"local": 1, "processes": options.workers, "ray": options.workers}
    opened = {
        name: executor_class(name).open(model, experiments, count, None)
        for name, count in counts.items()
    }
    number = max(4 * options.workers, int(options.seconds / wanted))
    rates: dict[str, list[float]] = {name: [] for name in counts}
    shares: dict[str, list[float]] = {name: [] for name in counts}
    for executor in opened.values():
        measure(executor, max(20, number // 20))
    for _ in range(options.rounds):
        for name, executor in opened.items():
            rate, busy = measure(executor, number)
            rates[name].append(rate)
            shares[name].append(min(busy))
    for executor in opened.values():
        executor.close()
    one = statistics.median(rates["local"])
    for name, each in rates.items():
        yield {"simulation ms": wanted * 1e3, "executor": name, "workers": counts[name],
               "busy at least": statistics.median(shares[name]),
               "a second": statistics.median(each),
               "of one local core": statistics.median(each) / one}  # fmt: skip


def measure(executor: Executor, number: int) -> tuple[float, list[float]]:
    """Do so many simulations: how many a second, and the share of time each worker simulated."""
    points = np.zeros((number, 4))
    points[:, 0] = np.linspace(0.5, 1.5, number)
    tasks = [Task(i, 0, point) for i, point in enumerate(points)]
    busy: defaultdict[str, float] = defaultdict(float)
    begin = time.perf_counter()
    left = iter(range(0, number, AT_ONCE))
    asked = answered = 0
    while answered < number:
        while asked - answered < 2 * AT_ONCE and (first := next(left, None)) is not None:
            executor.submit(tasks[first : first + AT_ONCE])
            asked += len(tasks[first : first + AT_ONCE])
        for outcome in executor.completed():
            assert outcome.ok, outcome.message
            busy[outcome.worker] += outcome.seconds
            answered += 1
    seconds = time.perf_counter() - begin
    per_worker = [busy[worker] / seconds for worker in busy]
    per_worker += [0.0] * (executor.workers - len(busy))
    return number / seconds, per_worker
