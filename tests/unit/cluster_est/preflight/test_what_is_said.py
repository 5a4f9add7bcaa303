"""What a check says of probes that were not answered in full, or with no number."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.problems.springs import FMU

from cluster_est import Resources
from cluster_est.preflight import bare_problem, run_checks
from cluster_est.preflight.findings import CheckVerdict
from cluster_est.preflight.parameters import corners
from cluster_est.preflight.repeatability import _leftovers
from cluster_est.preflight.simulation_costs import _few_simulations, _memory
from cluster_est.preflight.solver_checks import accuracy, derivatives
from workers.probes.probes import SimulationCost
from workers.process.trial import NoAnswer
from workers.simulation.jacobian import StateJacobian

DESCRIPTION = SimpleNamespace(
    offer=lambda _: SimpleNamespace(provides_directional_derivatives=True),
    states=("x",),
    variable_steps=False,
)


class Subject:
    """One whose probes have this answer."""

    description = DESCRIPTION
    budget = SimpleNamespace(left=4.0, seconds=4.0)
    space = SimpleNamespace(lower=np.zeros(1), upper=np.ones(1), start=np.full(1, 0.5), acting=[()])
    start = np.full(1, 0.5)
    experiment = 0
    repeats = True
    probe_arguments = (0, np.zeros(1), "reset")

    def __init__(self, answer: Any = None, interface: str = "model_exchange") -> None:
        model = SimpleNamespace(interface=interface)
        self.answer = answer
        # effects keep what derivatives cost from being tried too
        self.problem = SimpleNamespace(model=model, effects=("effect",))

    def at(self, x: Any) -> Any:
        return x

    def ask(self, *_: Any) -> Any:
        return self.answer


OK, NOTE, NOT_DONE = CheckVerdict.OK, CheckVerdict.NOTE, CheckVerdict.NOT_DONE


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ([0.1, 0.2], [(OK, "at their lower and upper bounds")]),
        ([0.1], [(OK, "simulated with all parameters at their lower bounds"),
                 (NOT_DONE, "not simulated with all parameters at their upper bounds")]),
        ([], [(NOT_DONE, "not simulated with all parameters at their lower and upper bounds")]),
        (["it stops"], [(NOTE, "lower bounds: it stops"), (NOT_DONE, "at their upper bounds")]),
        (["it stops", 0.2], [(NOTE, "lower bounds: it stops")]),
    ],
)  # fmt: skip
def test_only_bounds_that_were_tried_are_said_to_be_good(answer, expected):
    found = corners(Subject(answer))
    assert [each.verdict for each in found] == [verdict for verdict, _ in expected]
    assert all(said in each.found for each, (_, said) in zip(found, expected, strict=True))


@pytest.mark.parametrize(("error", "verdict"), [(1e-9, OK), (1.0, NOTE), (np.nan, NOTE)])
def test_directional_derivatives_that_are_no_numbers_agree_with_nothing(error, verdict):
    (found,) = derivatives(Subject(StateJacobian(error, zero=False)))
    assert found.verdict is verdict


def test_an_accuracy_that_cannot_be_measured_is_not_ok():
    (found,) = accuracy(Subject(interface="co_simulation"))
    assert found.verdict is NOT_DONE
    assert "cannot be halved" in found.found


@pytest.mark.parametrize("leak", [None, 0.0])
def test_too_few_simulations_do_not_show_that_nothing_leaks(leak):
    found = _memory(Subject(), SimulationCost(1e-3, leak, 64))
    assert found.verdict is NOT_DONE
    assert "64 simulations are too few" in found.found


def test_an_fmu_that_was_not_tried_is_said_to_be_that():
    (found,) = run_checks(bare_problem(FMU), Resources(), 0.0, declared=False).findings
    assert found.verdict is NOT_DONE
    assert "nothing was simulated" in found.found


def test_values_that_nobody_had_time_for_are_not_done():
    (found,) = _leftovers(Subject(NoAnswer("it would take about 5 s", late=True)))
    assert found.verdict is NOT_DONE


def test_a_plan_for_few_simulations_where_each_takes_long():
    assert _few_simulations(0.9) == []
    (found,) = _few_simulations(1.1)
    assert found.verdict is OK
    assert "trials = 1" in found.do
