"""What FMUs of other tools do that the standard hardly foresees, and calls that they rely on."""

import math
import os
import re
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from support.changed_fmus import with_description
from support.simulated import answer, answers

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import Experiment, Input, Limits, Model, Outcome, Output, Solver, Task
from workers.process.supervisor import SupervisedEvaluator
from workers.wire import TaskBatch

TIMES = np.linspace(0.0, 1.0, 3)
RUN = Experiment("e", 0.0, 1.0, (), (Output("y", TIMES, 0.0 * TIMES),))
EXACT = Solver("dormand_prince", rtol=1e-9)


def test_a_binary_with_other_event_indicators_than_described_is_refused(own_fmu, tmp_path):
    ball = own_fmu("bouncing_ball", 3)
    with zipfile.ZipFile(ball) as archive:
        described = archive.read("modelDescription.xml").decode()
    (indicator,) = re.findall(r"<EventIndicator [^>]*/>", described)
    fmu = with_description(ball, tmp_path / "ball.fmu", {indicator: ""})
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", EXACT, ())
    run = Experiment("e", 0.0, 1.0, (), (Output("height", TIMES, 0.0 * TIMES),))
    with pytest.raises(ModelError, match=r"must have the 0 event indicators .*, but has 1; export"):
        Evaluator(model, [run], "w")


PRINTING = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_what_fmus_do import answered
print(answered(Path(sys.argv[1])))
"""


def answered(fmu: Path) -> str:
    """The status of a simulation in a process of its own."""
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", EXACT, ())
    guard = SupervisedEvaluator(model, [RUN], "w", Limits(60.0))
    (outcome,) = guard.evaluate(TaskBatch.of([Task(0, 0, np.zeros(0))]))
    guard.close()
    return str(outcome.status)


def test_what_an_fmu_prints_stays_out_of_the_output(own_fmu):
    command = [sys.executable, "-c", PRINTING, str(own_fmu("prints", 2)), *sys.path]
    ended = subprocess.run(command, capture_output=True, check=True, text=True)
    assert ended.stdout == "ok\n"


@pytest.mark.parametrize(
    ("name", "fmi", "said"),
    [
        ("needs_tool", 2, r"the tool .* is not installed.*it needs"),
        ("needs_tool", 3, r"the tool .* is not installed.*it needs"),
        ("wrong_platform", 2, r"must have .*linux64.*, but has one for win64"),
    ],
)
def test_an_fmu_that_cannot_work_here_is_refused_with_the_reason(own_fmu, name, fmi, said):
    fmu = own_fmu(name, fmi)
    with pytest.raises(ModelError, match=said):
        Evaluator(Model(fmu.name, fmu.read_bytes(), "co_simulation", Solver("fmu"), ()), [RUN], "w")


def test_a_description_that_breaks_the_schema_does_no_harm(own_fmu):
    """dx/dt = -x from 1."""
    fmu = own_fmu("invalid_xml", 2)
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", EXACT, ())
    outcome = answer(model, RUN)
    np.testing.assert_allclose(-outcome.residuals, np.exp(-TIMES), rtol=1e-6)


VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
SOLVERS = [Solver("dormand_prince"), Solver("rk4", 0.05), Solver("cvode")]
SAMPLED = np.linspace(0.0, 1.95, 16)


def simulate(fmu, interface, solver, rates, inputs=(), parameter="k"):
    """Simulate a batch of points on one instance."""
    model = Model(fmu.name, fmu.read_bytes(), interface, solver, (parameter,))
    outputs = (Output("y", SAMPLED, np.zeros(len(SAMPLED))),)
    run = Experiment("e", 0.0, 2.0, inputs, outputs)
    tasks = [Task(i, 0, np.array([rate]), "residuals") for i, rate in enumerate(rates)]
    return answers(model, [run], tasks)


def found(outcome: Outcome) -> np.ndarray:
    """Return the output: what is measured is zero."""
    assert outcome.ok, outcome.message
    return -outcome.residuals


@pytest.mark.parametrize(
    ("solver", "fmi"),
    [(solver, fmi) for solver in SOLVERS for fmi in (2, 3)],
    ids=lambda value: getattr(value, "name", value),
)
def test_event_indicators_that_are_computed_only_when_a_variable_is_got(own_fmu, fmi, solver):
    """The switch is on while the input is above the threshold: a triangle up to 1."""
    triangle = Input("u", np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.0]), "linear")
    thresholds = (0.5, 0.3)
    outcomes = simulate(
        own_fmu("lazy_indicators", fmi), "model_exchange", solver, thresholds, (triangle,),
        "threshold",
    )  # fmt: skip
    for outcome, threshold in zip(outcomes, thresholds, strict=True):
        on = np.abs(SAMPLED - 1.0) < 1.0 - threshold
        assert 0 < on.sum() < len(on)
        np.testing.assert_array_equal(found(outcome), on)


@VERSIONS
@pytest.mark.parametrize("name", ["reset_new_crashes", "reset_new_spoils"])
@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation"])
def test_a_new_instance_is_not_reset(own_fmu, fmi, name, interface):
    """Where it is reset, this process dies, or every output is 2.4e-322."""
    solver = Solver("dormand_prince") if interface == "model_exchange" else Solver("fmu", 0.01)
    rates = (1.3, 0.4, 1.3)
    outcomes = simulate(own_fmu(name, fmi), interface, solver, rates)
    for outcome, rate in zip(outcomes, rates, strict=True):
        truth = [math.exp(-rate * t) for t in SAMPLED]
        np.testing.assert_allclose(found(outcome), truth, rtol=1e-5)


@VERSIONS
def test_communication_steps_are_exact_multiples(own_fmu, fmi):
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
def test_signals_stay_with_the_process(own_fmu, fmi):
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
