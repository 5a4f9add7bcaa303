"""What the parser itself answers."""

import sys
import tomllib

import pytest
from support.problems.springs import ROOT

from cluster_est.cli import main


@pytest.mark.parametrize("installed", [True, False])
def test_the_version_is_that_of_the_project_where_it_is_installed(capsys, monkeypatch, installed):
    if not installed:
        monkeypatch.setattr(sys, "path", [])
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    printed = capsys.readouterr().out
    assert (printed == f"cluster-est {project['version']}\n") is installed
    assert ("not installed" in printed) is not installed
