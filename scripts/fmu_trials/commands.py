"""Commands of cluster-est in processes of their own, and what became of them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from cluster_est.cli.parent_process import ExitCode

PROGRAM = [sys.executable, "-c", "from cluster_est.cli import run; run()"]


@dataclass(frozen=True)
class CommandEnd:
    """The end of a command: its exit code (None if it had to be ended), and what it said."""

    code: int | None
    output: str
    errors: str

    @property
    def fault(self) -> str:
        """Return what must never happen: a hang, a traceback, a death in silence; else ""."""
        if self.code is None:
            return "HANGS"
        if "Traceback (most recent call last)" in self.errors:
            return "TRACEBACK"
        if self.code not in set(ExitCode) and "has died" not in self.errors:
            return f"DIES IN SILENCE ({self.code})"
        return ""

    @property
    def last_sentence(self) -> str:
        """Return the last line of what it said to standard error."""
        lines = [line for line in self.errors.strip().splitlines() if line.strip()]
        return lines[-1].strip() if lines else ""


def run_command(arguments: list[str], folder: Path, seconds: float) -> CommandEnd:
    """Run a command in a folder, for some seconds at most."""
    try:
        ended = subprocess.run(
            [*PROGRAM, *arguments], cwd=folder, capture_output=True, timeout=seconds, check=False
        )
    except subprocess.TimeoutExpired:
        return CommandEnd(None, "", "")
    output, errors = (text.decode(errors="replace") for text in (ended.stdout, ended.stderr))
    return CommandEnd(ended.returncode, output, errors)


def check_fmu(file: Path, folder: Path, seconds: float) -> str:
    """Run `check` on an FMU alone: what came of it, in words."""
    ended = run_command(["check", str(file)], folder, seconds)
    if ended.fault:
        return f"{ended.fault}: {ended.last_sentence}"
    if ended.code == ExitCode.BAD_INPUT:
        return f"refused: {ended.last_sentence}"
    lines = [" ".join(line.split()) for line in ended.output.splitlines()]
    problems = [line for line in lines if line.startswith("problem")]
    return f"problems: {' | '.join(problems)}" if problems else "clean"
