"""The figures of a case, read from the folders of its runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from measured_league.cases import LeagueCase
from measured_league.running import Kind, finished_facts, run_folder


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
    """An effect that a loop has added: its name as "form at site of variables", and in words."""

    name: str
    equation: str


@dataclass(frozen=True)
class LoopFigures:
    """What a closed loop says, besides its figures."""

    figures: RunFigures
    verdict: str
    effects: tuple[NamedEffect, ...]


@dataclass(frozen=True)
class CaseFigures:
    """The runs of a case that are there; None stands for one that is not.

    Attributes
    ----------
    noise
        The loop's estimate, in the unit of the errors; without a loop, that of the base model's
        fit; NaN where neither says one.
    """

    case: LeagueCase
    base: RunFigures | None
    textbook: RunFigures | None
    loop: LoopFigures | None
    noise: float


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
        None if loop is None else _loop(loop, facts[Kind.LOOP] or {}),
        _noise(facts[Kind.LOOP], facts[Kind.BASE]),
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


def _loop(figures: RunFigures, facts: Mapping[str, Any]) -> LoopFigures:
    effects = tuple(
        NamedEffect(effect_name(each["form"], each["site"], each["variables"]), each["equation"])
        for each in facts["effects"]
    )
    return LoopFigures(figures, facts["verdict"], effects)


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
