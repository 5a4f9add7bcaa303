"""Co-simulation FMUs that cannot vary their communication step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import FMU

from workers.description import describe
from workers.errors import ModelError
from workers.install import install
from workers.messages import Experiment, Model, Output, Solver

DESCRIPTION = replace(describe(FMU.name, FMU.read_bytes()), variable_steps=False)


def installed(times, step):
    times = np.array(times)
    model = Model(FMU.name, FMU.read_bytes(), "co_simulation", Solver("fmu", step=step), ("k",))
    experiment = Experiment("e", 0.0, times[-1], (), (Output("y", times, 0.0 * times),))
    return install(model, DESCRIPTION, experiment)


@pytest.mark.parametrize(
    ("times", "step"),
    [([0.0, 0.1, 0.2], None), ([0.0, 0.1, 0.3, 0.4], None), ([0.0, 0.15, 0.25], 0.05)],
)
def test_multiples_of_one_step_are_taken(times, step):
    assert len(installed(times, step).grid.times) == len(times)


@pytest.mark.parametrize(
    ("times", "step"),
    [([0.0, 0.1, 0.25], None), ([0.0, 0.1, 0.25], 0.04), ([0.0, 0.1, 0.2], 0.3)],
)
def test_other_times_are_refused_with_advice(times, step):
    with pytest.raises(ModelError, match=r"experiment 'e'.*fixed length.*set model\.step"):
        installed(times, step)
