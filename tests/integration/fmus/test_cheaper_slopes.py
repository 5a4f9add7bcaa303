"""Sensitivities take the place of differences where they are cheaper, and the run remembers that.

Times are made up: the first worker says what it is told to say. The truth of the fit is by hand,
x' = -k x with x(0) = 1.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from cluster_est import Experiment, Output, Parameter, Problem, Solver
from cluster_est.cli import main
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.methods.pattern_search.method import PatternSearch
from cluster_est.methods.sqp.method import Sqp
from cluster_est.problem.space import make_space
from cluster_est.run_folder.evaluation_log import read_log
from cluster_est.running import sensitivity_policy as cheaper_slopes
from workers.messages import Model, Outcome, Status, Task

Give = Callable[[str, int], Path]
RATE = 1.3


class Timed:
    """A first worker whose simulations take times that are made up."""

    def __init__(self, plain: float, carried: float, *, gives: bool = True) -> None:
        self._seconds = {"residuals": plain, "sensitivities": carried}
        self._gives = gives
        self.asked: list[str] = []

    def first_worker(self, tasks: Sequence[Task]) -> list[Outcome]:
        self.asked += [task.want for task in tasks]
        return [
            Outcome(
                task.id, Status.OK, residuals=np.zeros(3), seconds=self._seconds[task.want],
                sensitivities=np.zeros((3, 2)) if self._gives else None,
            )
            for task in tasks
        ]  # fmt: skip


@pytest.fixture
def problem(own_fmu: Give) -> Problem:
    """Two parameters of an FMU that gives directional derivatives."""
    archive = own_fmu("states_directional", 2)
    model = Model(
        archive.name, archive.read_bytes(), "model_exchange", Solver("rk4", step=0.01), ("k", "c")
    )
    times = np.linspace(0.0, 1.0, 3)
    runs = tuple(
        Experiment(name, 0.0, 1.0, (), (Output("y", times, 0.0 * times, 1.0),)) for name in "abc"
    )
    return Problem(model, (Parameter("k", 1.0, 0.1, 5.0), Parameter("c", 1.0, 0.1, 5.0)), runs)


def found(problem: Problem, method: Any, executor: Timed) -> cheaper_slopes.SensitivityDecision:
    space = make_space(problem, problem.indices("train"))
    return cheaper_slopes.cheaper_slopes(executor, space, method)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("plain", "carried", "carry"),
    [(1.0, 0.9, True), (1.0, 1.1, False), (10.0, 30.0, False), (0.01, 0.001, False)],
)
def test_half_the_time_of_differences_is_needed(
    problem: Problem, plain: float, carried: float, carry: bool
) -> None:
    """Differences take two further simulations of an experiment with two unknowns."""
    assert found(problem, LeastSquares(), Timed(plain, carried)).carry == carry
    assert found(problem, Sqp(), Timed(plain, carried)).carry == carry


def test_short_fits_are_not_kept_waiting(problem: Problem) -> None:
    """Six simulations take less than a second for one Jacobian."""
    executor = Timed(0.1, 0.001)
    assert not found(problem, LeastSquares(), executor).carry
    assert "sensitivities" not in executor.asked


@pytest.mark.parametrize(
    "method", [LeastSquares(differences="forward"), LeastSquares(differences="central"),
               Sqp(differences="central"), PatternSearch()],
)  # fmt: skip
def test_nothing_is_tried_without_a_choice(problem: Problem, method: Any) -> None:
    executor = Timed(1.0, 0.1)
    assert not found(problem, method, executor).carry
    assert executor.asked == []
    assert cheaper_slopes.with_slopes(method, cheaper_slopes.SensitivityDecision(True)) == method


def test_an_fmu_that_gives_none(problem: Problem) -> None:
    assert not found(problem, LeastSquares(), Timed(1.0, 0.1, gives=False)).carry
    alone = replace(problem.model, interface="co_simulation", solver=Solver("fmu", step=0.1))
    executor = Timed(1.0, 0.1)
    assert not found(replace(problem, model=alone), LeastSquares(), executor).carry
    assert executor.asked == []


def fit(own_fmu: Give, folder: Path, *more: str) -> int:
    times = np.linspace(0.0, 2.0, 21)
    rows = [f"{t!r},{math.exp(-RATE * t)!r}" for t in times.tolist()]
    (folder / "a.csv").write_text("time,y\n" + "\n".join(rows) + "\n", encoding="utf-8")
    (folder / "config.toml").write_text(
        f"""
        parameters.k = {{ start = 0.7, bounds = [0.01, 10.0] }}
        [model]
        fmu = "{own_fmu("states_directional", 2)}"
        solver = "dormand_prince"
        [values]
        x = 1.0
        c = 1.0
        [[experiments]]
        id = "a"
        data = "a.csv"
        time = "time"
        outputs = {{ y = "y" }}
        """,
        encoding="utf-8",
    )
    return main(["fit", str(folder / "config.toml"), "--out", str(folder / "run"), *more])


@pytest.mark.parametrize(("cheaper", "when_resumed"), [(math.inf, 0.0), (0.0, math.inf)])
def test_the_run_says_so_and_keeps_to_it(
    own_fmu: Give,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    cheaper: float,
    when_resumed: float,
) -> None:
    monkeypatch.setattr(cheaper_slopes, "LEAST_SECONDS", 0.0)
    monkeypatch.setattr(cheaper_slopes, "CHEAPER", cheaper)
    assert fit(own_fmu, tmp_path, "budget.evaluations=4") == 1

    monkeypatch.setattr(cheaper_slopes, "CHEAPER", when_resumed)
    assert fit(own_fmu, tmp_path, "--resume", "budget.evaluations=1000") == 0
    run = tmp_path / "run"
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    assert facts["sensitivities"]["carry"] == (cheaper > 0.0)
    purposes = set(read_log(run / "evaluations").column("purpose").to_pylist())
    assert ("sensitivities" in purposes) == (cheaper > 0.0)
    (row,) = pq.read_table(run / "parameters.parquet").to_pylist()
    assert row["value"] == pytest.approx(RATE, rel=1e-6)
