"""pyarrow starts without pandas in the commands, and still takes a column of pandas later."""

import subprocess
import sys

import pytest
from support.problems.springs import ROOT

STARTED = """
import sys
from cluster_est.cli import main
main(["show", sys.argv[1]])
main(["check", sys.argv[2], "--seconds", "0"])
assert "pandas" not in sys.modules, "pandas was imported"
import pandas as pd
import pyarrow as pa
import cluster_est as ce
frame = pd.DataFrame({"t": [0.0, 1.0, 2.0], "y": [1.0, None, 3.0]})
run = ce.Experiment.from_table(frame, id="e", time="t", outputs=["y"])
assert run.outputs[0].values.tolist() == [1.0, 3.0]
assert pa.table({"a": [1]}).to_pandas().a.tolist() == [1]
print("as before")
"""


@pytest.mark.slow
def test_no_command_imports_pandas_and_python_users_lose_nothing(tmp_path):
    config = ROOT / "configs" / "mass_spring_damper.toml"
    done = subprocess.run(
        [sys.executable, "-c", STARTED, str(tmp_path), str(config)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1:] == ["as before"], done.stderr
