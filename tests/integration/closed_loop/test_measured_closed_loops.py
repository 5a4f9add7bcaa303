"""The closed loop on measured data, whose configs declare no effect.

Published figures (Champneys et al., arXiv 2405.10779): Silverbox arrow 14.4 mV linear, 0.26 mV at
best; cascaded tanks 0.588 V linear, 0.191 V at best. EMPS, relative error of the force by its
authors with Coulomb friction: 8.94 % on the pulses.
"""

from __future__ import annotations

import numpy as np
import pytest
from support.measured import PLACES, measured
from support.problems.springs import ROOT

import cluster_est as ce


def closed(name: str, file: str, monkeypatch: pytest.MonkeyPatch):
    """The loop on a config, with its own settings."""
    place = measured(file)
    folder = next(p for p in PLACES if place.is_relative_to(p))
    monkeypatch.setenv("CLUSTER_EST_DATA", str(folder))
    config = ce.read_config(ROOT / "configs" / f"{name}.toml")
    assert not config.effects
    problem = ce.build_problem(config, ROOT / "configs")
    from cluster_est.config.settings import build_settings

    result = ce.close_loop(problem, ce.Resources(workers=2), build_settings(config))
    return problem, result


def test_silverbox_has_a_cubic_stiffness(monkeypatch):
    _, result = closed("silverbox", "silverbox/SNLS80mV.csv", monkeypatch)
    assert result.verdict in ("found", "partial")
    first = result.effects[0]
    names = {("der(v)", "cubic", ("y",)), ("parameter k", "square", ("y",))}  # the same equation
    assert (first.site, first.form, first.variables) in names
    (arrow,) = [e for e in result.errors if e.role == "test"]
    assert 13e-3 < arrow.rmse_before < 15e-3
    assert arrow.rmse_after < 1.0e-3


def test_the_tanks_spill_over_and_are_full_at_ten_volts(monkeypatch):
    _, result = closed("cascaded_tanks", "cascaded_tanks/dataBenchmark.csv", monkeypatch)
    assert result.verdict in ("found", "partial")
    assert len(result.effects) > 1
    assert {"overflow", "hinge"} & {e.form for e in result.effects}
    (val,) = [e for e in result.errors if e.role == "test"]
    assert 0.6 < val.rmse_before < 0.72
    assert val.rmse_after < 0.34


def test_emps_has_coulomb_friction(monkeypatch):
    problem, result = closed("emps", "emps/DATA_EMPS.mat", monkeypatch)
    assert result.verdict in ("found", "partial")
    assert ("der(v)", "coulomb") in {(e.site, e.form) for e in result.effects}
    for row in result.errors:
        run = next(e for e in problem.experiments if e.id == row.experiment)
        size = float(np.sqrt(np.mean(run.outputs[0].values ** 2)))
        assert 0.15 < row.rmse_before / size < 0.18
        assert row.rmse_after / size < 0.065
