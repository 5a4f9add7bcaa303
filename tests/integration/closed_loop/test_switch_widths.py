"""A friction whose switch is wide is found by its name, with the width, and not patched."""

from __future__ import annotations

import numpy as np
import pytest
from support.problems.springs import FMU
from support.truth.springs_with_effects import TIMES, C, K, M, plain, solve

import cluster_est as ce
from cluster_est.closed_loop.findings.config_block import config_block
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.settings import LoopSettings

WIDTH, STRENGTH, NOISE = 0.02, 2.0, 1e-4
ROLES = ("train", "train", "test")


def rubbed(t, x, force):
    v, dv = plain(t, x, force)
    return [v, dv - STRENGTH * np.tanh(x[1] / WIDTH)]


@pytest.fixture(scope="module")
def result():
    random = np.random.default_rng(3)
    runs = []
    for number, role in enumerate(ROLES):
        turns = np.linspace(TIMES[0], TIMES[-1], 14)
        force = np.interp(TIMES, turns, random.uniform(-12.0, 12.0, len(turns)))
        truth = solve(rubbed, (0.1, 0.0), force=force)[:, 0]
        measured = truth + NOISE * random.normal(size=len(TIMES))
        runs.append(
            ce.Experiment(
                f"run{number}", 0.0, float(TIMES[-1]),
                (ce.Input("F", TIMES, force),),
                (ce.Output("y", TIMES, measured, sigma=NOISE),),
                (("x", 0.1),),
                role=role,
            )
        )  # fmt: skip
    solver = ce.Solver("dormand_prince")
    model = ce.Model(FMU.name, FMU.read_bytes(), "model_exchange", solver, ("m", "k", "c"))
    parameters = (
        ce.Parameter("m", 1.1 * M, 0.1, 10.0),
        ce.Parameter("k", 0.9 * K, 1.0, 100.0),
        ce.Parameter("c", 1.1 * C, 0.0, 10.0),
    )
    problem = ce.Problem(model, parameters, tuple(runs))
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
