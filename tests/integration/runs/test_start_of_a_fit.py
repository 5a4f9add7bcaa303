"""A fit loads nothing that is slow to load and that it has no use for."""

import subprocess
import sys
from pathlib import Path

import pytest
from support.problems.springs import ROOT

from cluster_est.run_folder.reading import read_run_table

SLOW = (
    "sympy",
    "scipy.signal",
    "scipy.stats",
    "scipy.integrate",
    "pyarrow.dataset",
    "ray",
    "SALib",
)
CODE = """
import sys
from cluster_est.cli import main

code = main(["fit", sys.argv[1], "--out", sys.argv[2]])
print("loaded:", *(name for name in sys.argv[3:] if name in sys.modules))
sys.exit(code)
"""


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> tuple[Path, str]:
    run = tmp_path_factory.mktemp("start") / "k=3"
    config = ROOT / "configs" / "mass_spring_damper.toml"
    asked = [sys.executable, "-c", CODE, str(config), str(run), *SLOW]
    done = subprocess.run(asked, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return run, done.stdout


def test_a_fit_with_its_report_loads_no_module_that_it_does_not_need(fitted):
    run, printed = fitted
    assert (run / "report.html").is_file()
    assert printed.splitlines()[-1] == "loaded:"


def test_a_folder_whose_name_looks_like_a_column_adds_none_to_its_tables(fitted):
    """Readers of partitioned data make a column of a folder that is named k=3."""
    rows = read_run_table(fitted[0] / "errors.parquet")
    assert len(rows) == 5
    assert "k" not in rows[0]
