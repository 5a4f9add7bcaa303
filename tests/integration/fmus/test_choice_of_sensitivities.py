"""Sensitivities are recommended by a clock and chosen by a key. Times are made up."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.decay_fits import fit_decay

from cluster_est import Experiment, Output, Parameter, Problem, Solver
from cluster_est.preflight.sensitivities import sensitivities
from cluster_est.preflight.subject import CheckSubject, TimeBudget
from cluster_est.problem.search_space.space import make_space
from workers.messages import Model
from workers.probes.sensitivities import SensitivityCost, SensitivityCostProbe
from workers.process.trial import ProbeBench

Give = Callable[[str, int], Path]


@dataclass
class Bench:
    """Answers with a cost that is made up."""

    cost: SensitivityCost | None
    asked: list[Any] = field(default_factory=list)

    def ask(self, probe: Any, seconds: float) -> SensitivityCost | None:
        self.asked.append(probe)
        return self.cost


@pytest.fixture
def problem(own_fmu: Give) -> Problem:
    """Two parameters of an FMU that gives directional derivatives."""
    archive = own_fmu("states_directional", 2)
    solver = Solver("rk4", step=0.01)
    model = Model(archive.name, archive.read_bytes(), "model_exchange", solver, ("k", "c"))
    times = np.linspace(0.0, 1.0, 3)
    run = Experiment("a", 0.0, 1.0, (), (Output("y", times, 0.0 * times, 1.0),))
    return Problem(model, (Parameter("k", 1.0, 0.1, 5.0), Parameter("c", 1.0, 0.1, 5.0)), (run,))


def subject(problem: Problem, bench: Any) -> CheckSubject:
    return CheckSubject(problem, problem.describe(), bench, TimeBudget.of(60.0))


@pytest.mark.parametrize(
    ("plain", "carrying", "recommended"), [(1.0, 0.9, True), (1.0, 1.1, False), (0.1, 5.0, False)]
)
def test_half_the_time_of_differences_is_needed(
    problem: Problem, plain: float, carrying: float, recommended: bool
) -> None:
    """Differences take two further simulations of an experiment with two unknowns."""
    (found,) = sensitivities(subject(problem, Bench(SensitivityCost(plain, carrying))))
    assert f"takes {carrying / plain / 2.0:.2g} of the time of the 2" in found.found
    assert ('method.options.differences = "sensitivities"' in found.do) == recommended


def test_nothing_is_said_where_there_are_none(problem: Problem) -> None:
    assert sensitivities(subject(problem, Bench(None))) == []


def test_what_is_timed_gives_sensitivities(problem: Problem) -> None:
    space = make_space(problem, (0,))
    with ProbeBench.open(problem.model, problem.experiments) as bench:
        found = bench.ask(SensitivityCostProbe(0, space.physical(space.start)[0]), 300.0)
    assert isinstance(found, SensitivityCost)
    assert min(found.plain, found.carrying) > 0.0


def test_a_run_that_a_clock_had_chosen_them_for_is_refused(
    own_fmu: Give, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Resumed with differences, it would be half the one and half the other."""
    fmu = own_fmu("states_directional", 2)
    fit_decay(tmp_path, fmu, "--no-report", "budget.evaluations=2")
    (tmp_path / "run" / "parameters.parquet").unlink()
    resumed = tmp_path, fmu, "--no-report", "--resume"
    assert fit_decay(*resumed, "budget.evaluations=3") in (0, 1)

    (tmp_path / "run" / "parameters.parquet").unlink()
    known = tmp_path / "run" / "run.json"
    run = json.loads(known.read_text(encoding="utf-8"))
    run["sensitivities"] = {"carry": True, "sentence": "quicker"}
    known.write_text(json.dumps(run), encoding="utf-8")
    assert fit_decay(*resumed, "budget.evaluations=4") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert 'differences = "sensitivities" has to say' in said
