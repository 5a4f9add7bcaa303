"""What FMUs of other tools do and the standard does not foresee, or hardly."""

import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.changed_fmus import with_description
from support.simulated import answer

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import Experiment, Limits, Model, Output, Solver, Task
from workers.process.supervisor import SupervisedEvaluator
from workers.wire import TaskBatch

Give = Callable[[str, int], Path]

TIMES = np.linspace(0.0, 1.0, 3)
RUN = Experiment("e", 0.0, 1.0, (), (Output("y", TIMES, 0.0 * TIMES),))
EXACT = Solver("dormand_prince", rtol=1e-9)


def test_a_binary_with_other_event_indicators_than_described_is_refused(
    own_fmu: Give, tmp_path: Path
) -> None:
    ball = own_fmu("bouncing_ball", 3)
    (indicator,) = re.findall(r"<EventIndicator [^>]*/>", description_of(ball))
    fmu = with_description(ball, tmp_path / "ball.fmu", {indicator: ""})
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", EXACT, ())
    run = Experiment("e", 0.0, 1.0, (), (Output("height", TIMES, 0.0 * TIMES),))
    with pytest.raises(ModelError, match=r"must have the 0 event indicators .* but has 1; export"):
        Evaluator(model, [run], "w")


def description_of(fmu: Path) -> str:
    with zipfile.ZipFile(fmu) as archive:
        return archive.read("modelDescription.xml").decode()


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


def test_what_an_fmu_prints_stays_out_of_the_output(own_fmu: Give) -> None:
    command = [sys.executable, "-c", PRINTING, str(own_fmu("prints", 2)), *sys.path]
    ended = subprocess.run(command, capture_output=True, check=True, text=True)
    assert ended.stdout == "ok\n"


@pytest.mark.parametrize(
    ("name", "fmi", "said"),
    [
        ("needs_tool", 2, r"the tool .* is not installed.*it needs"),
        ("needs_tool", 3, r"the tool .* is not installed.*it needs"),
        ("wrong_platform", 2, r"must have .*linux64.* but has one for win64"),
    ],
)
def test_an_fmu_that_cannot_work_here_is_refused_with_the_reason(
    own_fmu: Give, name: str, fmi: int, said: str
) -> None:
    fmu = own_fmu(name, fmi)
    with pytest.raises(ModelError, match=said):
        Evaluator(Model(fmu.name, fmu.read_bytes(), "co_simulation", Solver("fmu"), ()), [RUN], "w")


def test_a_description_that_breaks_the_schema_does_no_harm(own_fmu: Give) -> None:
    """dx/dt = -x from 1."""
    fmu = own_fmu("invalid_xml", 2)
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", EXACT, ())
    outcome = answer(model, RUN)
    np.testing.assert_allclose(-outcome.residuals, np.exp(-TIMES), rtol=1e-6)
