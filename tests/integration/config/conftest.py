"""A command that must refuse its input: exit code 2, a line for each problem, nothing written."""

import re

import pytest
from support.spoiled import ROWS, write_input

from cluster_est.cli import main


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Run a command in the folder of the input; each pattern must be found in what it says."""
    monkeypatch.chdir(tmp_path)

    def call(arguments, *patterns, lines=1):
        before = sorted(tmp_path.rglob("*"))
        code = main(arguments)
        out, said = capsys.readouterr()
        assert code == 2, said
        assert out == ""
        assert said.startswith("cluster-est: ")
        assert "Traceback" not in said
        assert said.count("\n") == lines, said
        for pattern in patterns:
            assert re.search(pattern, said, re.DOTALL), said
        assert sorted(tmp_path.rglob("*")) == before
        return said

    return call


@pytest.fixture
def refuse(tmp_path, refused):
    """Spoil the config or the rows of its data, and see that `check` refuses it so."""

    def call(changes, *patterns, rows=ROWS, more=()):
        write_input(tmp_path, changes, rows)
        return refused(["check", "config.toml", *more], *patterns)

    return call
