"""What the parser itself answers."""

from __future__ import annotations

import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from cluster_est.cli import parser

PROJECT = Path(__file__).parents[4] / "pyproject.toml"


def test_the_version_is_that_of_the_project(capsys):
    with pytest.raises(SystemExit) as ended:
        parser.parse(["--version"])
    assert ended.value.code == 0
    version = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["version"]
    assert capsys.readouterr().out == f"cluster-est {version}\n"


def test_a_folder_in_which_it_is_not_installed_has_no_version(capsys, monkeypatch):
    def missing(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(parser, "version", missing)
    with pytest.raises(SystemExit):
        parser.parse(["--version"])
    assert "not installed" in capsys.readouterr().out
