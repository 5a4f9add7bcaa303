"""What the log of a loop on long records leaves out."""

from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.long_records import with_slim_log
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.running.environment import Monitor, RunEnvironment
from cluster_est.running.resources import TaskOrigin
from workers.messages import Outcome, Status, Task


def test_an_environment_keeps_what_another_one_has_left_out() -> None:
    found = []
    environment = RunEnvironment(monitor=Monitor(lambda origin, _: found.append(origin.slim)))
    trials = with_slim_log(environment, (LoopStage.TRIALS,))
    everything = with_slim_log(trials)
    origin = TaskOrigin(Task(0, 0, np.zeros(1), "residuals"), LoopStage.FINAL.value, 0, "start")
    outcome = Outcome(0, Status.OK, np.zeros(3))
    for told in (environment, trials, everything):
        assert told.monitor.record is not None
        told.monitor.record(origin, outcome)
    assert found == [False, False, True]
    assert trials.monitor.record is not None
    trials.monitor.record(replace(origin, search=LoopStage.TRIALS.value), outcome)
    assert found[-1]
