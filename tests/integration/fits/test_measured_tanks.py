"""The measured cascaded tanks: real input, from the shell's entry point to the tables."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.integrate import solve_ivp
from support.measured import measured
from support.problems.springs import ROOT

from cluster_est.cli import main

FILE = "cascaded_tanks/dataBenchmark.csv"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    measured(FILE)
    folder = tmp_path_factory.mktemp("tanks") / "run"
    config = ROOT / "configs" / "cascaded_tanks.toml"
    assert main(["fit", str(config), "--out", str(folder)]) == 0
    return folder


def test_base_model_reaches_its_error_on_the_test_record(run):
    errors = {row["experiment"]: row for row in pq.read_table(run / "errors.parquet").to_pylist()}
    assert errors["Val"]["role"] == "test"
    assert errors["Est"]["rmse_after"] < 0.61
    assert errors["Val"]["rmse_after"] < 0.70
    assert errors["Est"]["rmse_before"] > 2.0


def test_test_record_took_no_part(run):
    rows = pq.read_table(run / "parameters.parquet").to_pylist()
    assert {row["estimated_on"] for row in rows} == {"train"}


def test_simulated_levels_are_those_of_scipy(run):
    """The reported curve, on equations written down again, for the first 100 samples."""
    values = {r["label"]: r["value"] for r in pq.read_table(run / "parameters.parquet").to_pylist()}
    rows = pq.read_table(run / "residuals.parquet").to_pylist()
    simulated = [row["simulated"] for row in rows if row["experiment"] == "Est"][:100]
    pump = np.genfromtxt(measured(FILE), delimiter=",", skip_header=1, usecols=0)
    levels, lower = np.array([values["h1"], values["h2"]]), [values["h2"]]
    for k in range(99):

        def slope(t, h, u=pump[k]):
            flow = values["k1"] * np.sqrt(max(h[0], 0.0))
            return [values["kp"] * u - flow, flow - values["k2"] * np.sqrt(max(h[1], 0.0))]

        step = solve_ivp(slope, (0.0, 4.0), levels, rtol=1e-11, atol=1e-12)
        levels = step.y[:, -1]
        lower.append(levels[1])
    np.testing.assert_allclose(simulated, lower, rtol=1e-7)
