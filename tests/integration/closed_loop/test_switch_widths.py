"""A friction whose switch is wide is found by its name, with the width, and not patched."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems.measured_springs import measured_springs
from support.truth.springs_with_effects import M, plain

import cluster_est as ce
from cluster_est.closed_loop.findings.config_block import config_block
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.settings import LoopSettings

WIDTH, STRENGTH = 0.02, 2.0


def rubbed(t, x, force):
    v, dv = plain(t, x, force)
    return [v, dv - STRENGTH * np.tanh(x[1] / WIDTH)]


@pytest.fixture(scope="module")
def result():
    problem = measured_springs(
        rubbed,
        ce.Parameter("m", 1.1 * M, 0.1, 10.0),
        swing=12.0,
        noise=1e-4,
        random=np.random.default_rng(3),
        roles=("train", "train", "test"),
    )
    return ce.close_loop(problem, settings=LoopSettings(sites=("der(v)", "input F", "output y")))


def test_it_is_one_friction(result):
    assert result.verdict == Verdict.FOUND
    (effect,) = result.effects
    assert (effect.site, effect.form) == ("der(v)", "coulomb")


def test_the_width_is_estimated(result):
    values = {e.parameter: e.value for e in result.effects[0].coefficients}
    assert values["coulomb_v.k"] == pytest.approx(STRENGTH, rel=0.01)
    assert values["coulomb_v.width"] == pytest.approx(WIDTH, rel=0.1)
    assert result.rms("test", "after") < 1.1


def test_it_is_written_to_the_config_with_an_unknown_width(result):
    (block,) = [config_block(effect) for effect in result.effects]
    assert "width" in block
    assert "fixed" not in block
