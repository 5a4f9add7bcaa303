"""Fits and closed loops of the cases, each in a process and a folder of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from cluster_est.run_folder.run_files import RunStatus
from measured_league.cases import LeagueCase, textbook_config
from measured_league.convert import convert

PROGRAM = [sys.executable, "-c", "from cluster_est.cli import run; run()"]
FINISHED = (RunStatus.DONE, RunStatus.NOT_CONVERGED)
DATA, CONVERTED = "CLUSTER_EST_DATA", "CLUSTER_EST_CONVERTED"


class Kind(StrEnum):
    """What is done with a case. A member's text is the name of its folder."""

    BASE = "base"
    TEXTBOOK = "textbook"
    LOOP = "loop"


@dataclass(frozen=True)
class Ended:
    """How a run ended: its case and kind, and a word or the last line that it printed."""

    case: str
    kind: Kind
    how: str


def run_cases(
    cases: Iterable[LeagueCase], kinds: Iterable[Kind], out: Path, minutes: float, workers: int
) -> Iterator[Ended]:
    """Run what has not run yet, one after the other, with default settings.

    Parameters
    ----------
    cases, kinds
        What to run.
    out
        The folder of the league; `out/CASE/KIND` is the run's folder and `out/CASE/KIND.txt` what
        it printed. A run that has ended is not run again.
    minutes
        After which a run is ended. It has no result then.
    workers
        Simulations at a time.

    Yields
    ------
    Ended
        After each run.
    """
    environment = prepared_environment(out)
    chosen = list(kinds)
    for case in cases:
        for kind in chosen:
            if finished_facts(run_folder(out, case, kind)) is None:
                how = _run(case, kind, out, minutes, workers, environment)
                yield Ended(case.name, kind, how)


def prepared_environment(out: Path) -> dict[str, str]:
    """The environment of a run, in which the converted tables are found."""
    data = os.environ.get(DATA)
    if data:
        convert(Path(data), out / "converted")
    return {CONVERTED: str((out / "converted").resolve())} | dict(os.environ)


def run_folder(out: Path, case: LeagueCase, kind: Kind) -> Path:
    """The folder of a run."""
    return out / case.name / kind.value


def finished_facts(folder: Path) -> dict[str, Any] | None:
    """What a run says of itself; None where there is none, or where it has not ended by itself."""
    file = folder / "run.json"
    if not file.is_file():
        return None
    facts: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return facts if facts["status"] in FINISHED else None


def _run(
    case: LeagueCase,
    kind: Kind,
    out: Path,
    minutes: float,
    workers: int,
    environment: dict[str, str],
) -> str:
    folder = run_folder(out, case, kind)
    folder.parent.mkdir(parents=True, exist_ok=True)
    config = case.config
    if kind is Kind.TEXTBOOK:
        config = folder.parent / "textbook.toml"
        config.write_text(textbook_config(case), encoding="utf-8")
    command = "close-loop" if kind is Kind.LOOP else "fit"
    settings = [f"executor.workers={workers}", "--overwrite", "--no-report"]
    arguments = [*PROGRAM, command, str(config), *settings, "--out", str(folder)]
    with folder.with_suffix(".txt").open("wb") as printed:
        try:
            ended = subprocess.run(
                arguments,
                env=environment,
                stdout=printed,
                stderr=subprocess.STDOUT,
                timeout=60.0 * minutes,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"ended after {minutes:g} minutes, without a result"
    return "done" if ended.returncode == 0 else last_line(folder.with_suffix(".txt"))


def last_line(file: Path) -> str:
    """The last line of a text, which says why a command failed."""
    lines = [line for line in file.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1].strip() if lines else "failed in silence"
