"""Fits and closed loops of the cases, each in a process and a folder of its own: their figures."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from cluster_est.run_folder.run_files import RunStatus
from measured_league.cases import LeagueCase, convert, textbook_config

PROGRAM = [sys.executable, "-c", "from cluster_est.cli import run; run()"]
FINISHED = (RunStatus.DONE, RunStatus.NOT_CONVERGED)
DATA, CONVERTED = "CLUSTER_EST_DATA", "CLUSTER_EST_CONVERTED"


class Kind(StrEnum):
    """What is done with a case. A member's text is the name of its folder."""

    BASE = "base"
    TEXTBOOK = "textbook"
    LOOP = "loop"


@dataclass(frozen=True)
class EndedRun:
    """How a run ended: its case and kind, and a word or the last line that it printed."""

    case: str
    kind: Kind
    how: str


def run_cases(
    cases: Iterable[LeagueCase], kinds: Iterable[Kind], out: Path, minutes: float, workers: int
) -> Iterator[EndedRun]:
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
    EndedRun
        After each run.
    """
    environment = prepared_environment(out)
    chosen = list(kinds)
    for case in cases:
        for kind in chosen:
            if kind is Kind.TEXTBOOK and case.textbook is None:
                continue
            if finished_facts(run_folder(out, case, kind)) is None:
                how = _run(case, kind, out, minutes, workers, environment)
                yield EndedRun(case.name, kind, how)


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
    """What a run says of itself; None for a missing run, or one that has not ended by itself."""
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


@dataclass(frozen=True)
class RunFigures:
    """What came of one run.

    Attributes
    ----------
    train, test
        Root mean square errors over all samples of all outputs and records, in `unit`.
    simulations, seconds
        What it took.
    """

    train: float
    test: float
    unit: str
    simulations: int
    seconds: float


@dataclass(frozen=True)
class NamedEffect:
    """An effect that a loop has added, or a lead: its name as "form at site of variables".

    `probability` is that of being right, as the loop says it; NaN for a lead that was not added.
    """

    name: str
    equation: str
    probability: float = math.nan


@dataclass(frozen=True)
class LoopFigures:
    """What a closed loop says, besides its figures.

    Attributes
    ----------
    path
        Held-out errors over their noise, by labels: the base model, which has no label, then the
        structures that the search accepted, in this order. NaN where there is none.
    answer
        The same of its answer, which may be the base model.
    leads
        The effects that it did not add but names as its best guess, in their order.
    """

    figures: RunFigures
    verdict: str
    effects: tuple[NamedEffect, ...]
    path: Mapping[tuple[str, ...], float] = field(default_factory=dict)
    answer: float = math.nan
    leads: tuple[NamedEffect, ...] = ()

    @property
    def over_least(self) -> float:
        """The answer's held-out error over the least of the path and the answer.

        NaN if the search accepted no effect, or if there is no held-out error.
        """
        accepted = [error for labels, error in self.path.items() if labels]
        if not any(map(math.isfinite, accepted)):
            return math.nan
        errors = (*self.path.values(), self.answer)
        return self.answer / min(error for error in errors if math.isfinite(error))


@dataclass(frozen=True)
class CaseFigures:
    """The runs of a case that are there; None stands for one that is not.

    Attributes
    ----------
    noise
        The loop's estimate, in the unit of the errors; without a loop, that of the base model's
        fit; NaN where neither says one.
    records
        Errors by held-out record of the base model and of the loop.
    """

    case: LeagueCase
    base: RunFigures | None
    textbook: RunFigures | None
    loop: LoopFigures | None
    noise: float
    records: tuple[Mapping[str, float], ...] = ()


def read_case(case: LeagueCase, out: Path) -> CaseFigures:
    """Read the runs of a case.

    Parameters
    ----------
    case
        Which one.
    out
        The folder of the league.
    """
    facts = {kind: finished_facts(run_folder(out, case, kind)) for kind in Kind}
    base, textbook, loop = (_figures(out, case, kind, facts[kind]) for kind in Kind)
    return CaseFigures(
        case,
        base,
        textbook,
        None
        if loop is None
        else _loop(loop, facts[Kind.LOOP] or {}, _accepted(run_folder(out, case, Kind.LOOP))),
        _noise(facts[Kind.LOOP], facts[Kind.BASE]),
        tuple(errors_by_record(out, case, kind) for kind in (Kind.BASE, Kind.LOOP)),
    )


def pooled(rows: Iterable[Mapping[str, Any]], role: str) -> float:
    """The root mean square error over the samples of all rows of a role; NaN without any."""
    own = [row for row in rows if row["role"] == role and row["samples"]]
    count = sum(row["samples"] for row in own)
    squares = math.fsum(row["samples"] * row["rmse_after"] ** 2 for row in own)
    return math.sqrt(squares / count) if count else math.nan


def _figures(
    out: Path, case: LeagueCase, kind: Kind, facts: Mapping[str, Any] | None
) -> RunFigures | None:
    if facts is None:
        return None
    rows = pq.read_table(run_folder(out, case, kind) / "errors.parquet").to_pylist()
    return RunFigures(
        pooled(rows, "train"),
        pooled(rows, "test"),
        rows[0]["unit"],
        facts["simulations"],
        facts["seconds"],
    )


def _accepted(folder: Path) -> dict[tuple[str, ...], float]:
    """The structures that a search accepted, also those that its answer has left again.

    The latter are no longer marked as accepted, but only accepted structures have the error of
    cross-validation. If a structure has several rows, only the last one has its errors.
    """
    rows = pq.read_table(folder / "structures.parquet").to_pylist()
    return {
        tuple(row["effects"]): row["held_out"]
        for row in rows
        if row["effects"] and (row["accepted"] or math.isfinite(row["left_out"]))
    }


def errors_by_record(out: Path, case: LeagueCase, kind: Kind) -> dict[str, float]:
    """The root mean square error of each held-out record of a run, over all of its outputs."""
    file = run_folder(out, case, kind) / "errors.parquet"
    rows = pq.read_table(file).to_pylist() if file.is_file() else []
    records = dict.fromkeys(row["experiment"] for row in rows if row["role"] == "test")
    return {
        name: pooled((row for row in rows if row["experiment"] == name), "test") for name in records
    }


def _loop(
    figures: RunFigures, facts: Mapping[str, Any], accepted: Mapping[tuple[str, ...], float]
) -> LoopFigures:
    effects, leads = (tuple(map(_effect, facts[key])) for key in ("effects", "rejected"))
    errors = facts["errors"]["test"]
    base, answer = (math.nan if errors[w] is None else errors[w] for w in ("before", "after"))
    path = {(): base, **accepted}
    return LoopFigures(figures, facts["verdict"], effects, path, answer, leads)


def _effect(each: Mapping[str, Any]) -> NamedEffect:
    probability = (each["claim"] or {}).get("probability")
    name = effect_name(each["form"], each["site"], each["variables"])
    return NamedEffect(name, each["equation"], math.nan if probability is None else probability)


def effect_name(form: str, site: str, variables: Iterable[str]) -> str:
    """An effect's name, such as "coulomb at der(v) of v"."""
    of = ", ".join(variables)
    return f"{form} at {site} of {of}" if of else f"{form} at {site}"


def _noise(loop: Mapping[str, Any] | None, base: Mapping[str, Any] | None) -> float:
    """Over all outputs, which count alike."""
    if loop is not None:
        found = list(loop["noise"].values())
    else:
        residuals = (base or {}).get("residuals") or {}
        found = [each["noise_over_sigma"] for each in residuals.get("outputs", [])]
    known = [each for each in found if each is not None and math.isfinite(each)]
    return math.sqrt(sum(each**2 for each in known) / len(known)) if known else math.nan
