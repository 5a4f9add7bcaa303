"""Fork servers come from one template process, and take on what the program has at the moment."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

from workers.messages import Experiment, Input, Limits, Model, Outcome, Output, Task
from workers.process.supervisor import SupervisedEvaluator
from workers.process.template_client import TEMPLATE
from workers.wire import TaskBatch

TIMES = np.linspace(0.0, 2.0, 9)
EXPERIMENT = Experiment(
    "a",
    0.0,
    2.0,
    (Input("u", TIMES, np.sin(TIMES)),),
    (Output("y", TIMES, np.zeros(9)),),
)
CHECK = 'exec "$0" -c "from cluster_est.cli import run; run()" check "$1" 2>&-'


@contextmanager
def opened(model: Model) -> Iterator[SupervisedEvaluator]:
    with closing(SupervisedEvaluator(model, (EXPERIMENT,), "guarded", Limits())) as guard:
        yield guard


def answer(guard: SupervisedEvaluator) -> Outcome:
    (outcome,) = guard.evaluate(TaskBatch.of([Task(0, 0, np.array([1.0, 0.0, 0.0, 0.0]))]))
    return outcome


def test_it_is_one_for_all(model):
    with opened(model) as one, opened(model) as other:
        template = TEMPLATE._process.pid
        assert one._forks.server != other._forks.server
        assert answer(one).residuals.tobytes() == answer(other).residuals.tobytes()
    with opened(model):
        assert TEMPLATE._process.pid == template


def test_what_a_process_reads_only_when_it_starts_needs_another_one(model, monkeypatch):
    with opened(model) as one:
        template = TEMPLATE._process.pid
        monkeypatch.setenv("LD_NEW_FOR_A_TEST", "1")
        with opened(model) as other:
            assert TEMPLATE._process.pid != template
            assert answer(one).residuals.tobytes() == answer(other).residuals.tobytes()


def test_other_variables_are_handed_on(model, monkeypatch):
    with opened(model):
        template = TEMPLATE._process.pid
    monkeypatch.setenv("NEW_FOR_A_TEST", "1")
    with opened(model) as guard:
        assert TEMPLATE._process.pid == template
        assert answer(guard).ok


def test_a_program_needs_no_standard_error(own_fmu: Callable[[str, int], Path]) -> None:
    command = ["sh", "-c", CHECK, sys.executable, str(own_fmu("dahlquist", 2))]
    ended = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    assert "no problem was found" in ended.stdout
