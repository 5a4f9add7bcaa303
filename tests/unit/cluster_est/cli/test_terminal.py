"""What is said beside the output of a command."""

from __future__ import annotations

import pytest

from cluster_est.cli import terminal


@pytest.mark.parametrize("before", [True, False])
def test_compiling_is_announced_only_where_there_is_something_to_compile(
    before: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(terminal, "compiled_before", lambda: before)
    terminal.say_if_compiled_first()
    said = " ".join(capsys.readouterr().err.split())
    assert ("are compiled for this machine first" in said) is not before
