"""What tests of processes share: an FMU that misbehaves as its parameters say."""

from __future__ import annotations

import pytest

from workers.messages import Model, Solver


@pytest.fixture
def model(built_fmu):
    parameters = "rate", "kind", "share", "leak"
    archive = built_fmu("misbehaves")
    return Model("misbehaves.fmu", archive, "model_exchange", Solver("rk4", 0.02), parameters)
