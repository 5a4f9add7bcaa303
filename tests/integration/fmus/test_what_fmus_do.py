"""What FMUs of other tools do and the standard does not foresee, or hardly."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import Experiment, Limits, Model, Output, Solver, Task
from workers.process.supervisor import SupervisedEvaluator
from workers.wire import TaskBatch

Give = Callable[[str, int], Path]

TIMES = np.linspace(0.0, 1.0, 3)
RUN = Experiment("e", 0.0, 1.0, (), (Output("y", TIMES, 0.0 * TIMES),))
EXACT = Solver("dormand_prince", rtol=1e-9)


def with_description(fmu: Path, change: Callable[[str], str], out: Path) -> Path:
    """Copy an FMU whose model description is changed."""
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "modelDescription.xml":
                data = change(data.decode()).encode()
            new.writestr(name, data)
    return out


def test_a_binary_with_other_event_indicators_than_described_is_refused(
    own_fmu: Give, tmp_path: Path
) -> None:
    def without(text: str) -> str:
        changed, count = re.subn(r"<EventIndicator [^>]*/>", "", text)
        assert count == 1
        return changed

    fmu = with_description(own_fmu("bouncing_ball", 3), without, tmp_path / "ball.fmu")
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", EXACT, ())
    run = Experiment("e", 0.0, 1.0, (), (Output("height", TIMES, 0.0 * TIMES),))
    with pytest.raises(ModelError, match=r"must have the 0 event indicators .* but has 1; export"):
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


def test_what_an_fmu_prints_stays_out_of_the_output(own_fmu: Give) -> None:
    command = [sys.executable, "-c", PRINTING, str(own_fmu("prints", 2)), *sys.path]
    ended = subprocess.run(command, capture_output=True, check=True, text=True)
    assert ended.stdout == "ok\n"


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_that_needs_its_tool_says_so(own_fmu: Give, fmi: int) -> None:
    fmu = own_fmu("needs_tool", fmi)
    with pytest.raises(ModelError, match=r"It said: the tool .* is not installed\..*; it needs .*"):
        Evaluator(Model(fmu.name, fmu.read_bytes(), "co_simulation", Solver("fmu"), ()), [RUN], "w")
