"""FMUs that work only with the calls that importers usually make, in the usual order."""

import math
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.simulated import answer, answers

from workers.messages import Experiment, Input, Model, Outcome, Output, Solver, Task

Give = Callable[[str, int], Path]

VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
SOLVERS = pytest.mark.parametrize(
    "solver",
    [Solver("dormand_prince"), Solver("rk4", 0.05), Solver("cvode")],
    ids=lambda solver: solver.name,
)
TIMES = np.linspace(0.0, 1.95, 16)


def simulate(
    fmu: Path,
    interface: str,
    solver: Solver,
    rates: tuple[float, ...],
    inputs: tuple[Input, ...] = (),
    parameter: str = "k",
) -> list[Outcome]:
    """Simulate a batch of points on one instance."""
    model = Model(fmu.name, fmu.read_bytes(), interface, solver, (parameter,))
    outputs = (Output("y", TIMES, np.zeros(len(TIMES))),)
    run = Experiment("e", 0.0, 2.0, inputs, outputs)
    tasks = [Task(i, 0, np.array([rate]), "residuals") for i, rate in enumerate(rates)]
    return answers(model, [run], tasks)


def found(outcome: Outcome) -> np.ndarray:
    """Return the output: what is measured is zero."""
    assert outcome.ok, outcome.message
    return -outcome.residuals


@VERSIONS
@SOLVERS
def test_event_indicators_that_are_computed_only_when_a_variable_is_got(
    own_fmu: Give, fmi: int, solver: Solver
) -> None:
    """The switch is on while the input is above the threshold: a triangle up to 1."""
    triangle = Input("u", np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.0]), "linear")
    thresholds = (0.5, 0.3)
    outcomes = simulate(
        own_fmu("lazy_indicators", fmi), "model_exchange", solver, thresholds, (triangle,),
        "threshold",
    )  # fmt: skip
    for outcome, threshold in zip(outcomes, thresholds, strict=True):
        on = np.abs(TIMES - 1.0) < 1.0 - threshold
        assert 0 < on.sum() < len(on)
        np.testing.assert_array_equal(found(outcome), on)


@VERSIONS
@pytest.mark.parametrize("name", ["reset_new_crashes", "reset_new_spoils"])
@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation"])
def test_a_new_instance_is_not_reset(own_fmu: Give, fmi: int, name: str, interface: str) -> None:
    """Where it is reset, this process dies, or every output is 2.4e-322."""
    solver = Solver("dormand_prince") if interface == "model_exchange" else Solver("fmu", 0.01)
    rates = (1.3, 0.4, 1.3)
    outcomes = simulate(own_fmu(name, fmi), interface, solver, rates)
    for outcome, rate in zip(outcomes, rates, strict=True):
        truth = [math.exp(-rate * t) for t in TIMES]
        np.testing.assert_allclose(found(outcome), truth, rtol=1e-5)


@VERSIONS
def test_communication_steps_are_exact_multiples(own_fmu: Give, fmi: int) -> None:
    """From 100 s on, differences of times are 0.04999999999999716 and the like."""
    fmu = own_fmu("needs_multiples", fmi)
    times = 100.0 + 0.05 * np.arange(40)
    assert len(np.unique(np.diff(times))) > 1
    for step in (None, 0.01):
        model = Model(fmu.name, fmu.read_bytes(), "co_simulation", Solver("fmu", step), ("k",))
        run = Experiment("e", 100.0, float(times[-1]), (), (Output("y", times, 0.0 * times),))
        outcome = answer(model, run, [0.7], "residuals")
        np.testing.assert_allclose(found(outcome), np.exp(-0.7 * (times - 100.0)), rtol=1e-5)


@VERSIONS
def test_signals_stay_with_the_process(own_fmu: Give, fmi: int) -> None:
    """Otherwise Ctrl-C would do nothing any more."""
    received: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for number in before:
            signal.signal(number, lambda number, _frame: received.append(number))
        simulate(own_fmu("takes_signals", fmi), "model_exchange", Solver("rk4", 0.05), (1.0, 2.0))
        for number in before:
            os.kill(os.getpid(), number)
        assert received == [signal.SIGINT, signal.SIGTERM]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
