"""The command init: a first config for an FMU and measured tables."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cluster_est.cli.answer import Answer
from cluster_est.cli.parent_process import ExitCode
from cluster_est.config.config_text import override
from cluster_est.config.experiment_keys import ExperimentDefaultsSection
from cluster_est.errors import ConfigError
from cluster_est.preflight.draft import ConfigDraft, draft
from cluster_est.preflight.draft_text import open_lines, write
from cluster_est.problem.tables.measured_table import Reading
from cluster_est.problem.tables.stand_ins import written
from cluster_est.settings import checked
from cluster_est.toml import dotted
from cluster_est.whole_files import write_output
from workers.fmu.description import nearest


def init(options: Namespace, answer: Answer) -> int:
    """Write a first config, and say what to fill in or to do next."""
    out = options.out or Path(f"{options.fmu.stem}.toml")
    if out.is_dir():
        raise ConfigError(f"--out: {out} must be a file, but is a folder; name a file in it")
    if out.exists() and not options.overwrite:
        raise ConfigError(
            f"--out: {out} exists already; choose another file, or replace it with --overwrite"
        )
    reading, codes = read_reading(options.read)
    found = draft(options.fmu, options.data, read_mapping(options.map), reading, codes)
    text = write(found, out.parent)
    write_output(out, text.encode())
    for run in {run.columns.path: run for run in found.runs}.values():
        for note in run.columns.notes:
            answer.say(f"{run.columns.path}: {note}")
    for said in (*found.notes, *_stand_ins(found)):
        answer.say(said)
    open_ = open_lines(text)
    missing = list(dict.fromkeys(name for run in found.runs for name in run.missing_inputs))
    answer.add(
        out=out,
        to_fill_in=[{"line": number, "text": line} for number, line in open_],
        missing_inputs=missing,
    )
    for number, line in open_:
        answer.say(f"{out}, line {number}: fill in {line.partition('  # ')[0]}")
    for key, column in _by_unit(found).items():
        answer.say(
            f"{out}{_place(text, f'{key} = ')}: {column!r} was chosen for {key}, because it is the "
            "only column whose unit matches the variable's; if that is wrong, name another column"
        )
    for variable, column in dict.fromkeys(each for run in found.runs for each in run.switches):
        answer.say(
            f"{out}{_place(text, dotted('columns', column))}: {column!r} is on or off, which is "
            f"read as 1 and 0 {variable.unit}; uncomment the line, and give the value that "
            f"{variable.name} has while {column!r} is on"
        )
    for name in missing:
        where = ", ".join(repr(run.id) for run in found.runs if name in run.missing_inputs)
        place = _place(text, f'{dotted("inputs", name)} = "COLUMN"')
        answer.say(
            f"{out}{place}: no column of {where} matches input {name!r}; name the column "
            "of this input in the config, otherwise the input keeps its start value",
        )
    answer.say(f"{out} was written; check its lines, then run: cluster-est check {out}")
    return ExitCode.DONE


def _stand_ins(found: ConfigDraft) -> Iterator[str]:
    """Yield a sentence for each number in a column that probably marks missing measurements."""
    where: dict[tuple[str, float], list[Path]] = {}
    for run in found.runs:
        for column in run.used:
            for value in column.stand_ins:
                where.setdefault((column.name, value), []).append(run.columns.path)
    for (name, value), paths in where.items():
        more = f" (and {len(paths) - 1} more tables)" if len(paths) > 1 else ""
        yield (
            f"{paths[0]}{more}: {name!r} contains {written(value)}, far from all other values, so "
            "the key missing was written; if this number was measured, remove it from the key"
        )


def _by_unit(found: ConfigDraft) -> dict[str, str]:
    """Return the columns identified only by their unit, by the keys of their variables."""
    return {
        dotted(kind, match.variable.name): match.column.name
        for run in found.runs
        for kind, matches in (("inputs", run.inputs), ("outputs", run.outputs))
        for match in matches
        if match.by_unit and match.column is not None
    }


def _place(text: str, begins: str) -> str:
    """Return the first line of a config that contains a text, as part of a sentence."""
    lines = enumerate(text.splitlines(), 1)
    place = next((number for number, line in lines if begins in line), None)
    return "" if place is None else f", line {place}"


def read_reading(texts: Sequence[str]) -> tuple[Reading, tuple[float, ...]]:
    """Read `KEY=VALUE` arguments with options for reading tables, and numbers for missing values.

    Raises
    ------
    ConfigError
        If a key is unknown or has a wrong value.
    """
    raw: dict[str, Any] = {"read": {}}
    known = [*(each for each in vars(Reading()) if each != "long"), "missing"]
    for text in texts:
        key = text.partition("=")[0].strip()
        if key not in known or "=" not in text:
            raise ConfigError(
                f"--read: must be KEY=VALUE with one of the keys {', '.join(known)}, but is "
                f"{text!r}{nearest(key, known)}"
            )
        override(raw, f"read.{text}")
    given = {key: _as_given(key, value) for key, value in raw["read"].items()}
    checked_keys = checked(ExperimentDefaultsSection, given, "--read")
    options = {key: getattr(checked_keys, key) for key in given if key != "missing"}
    return Reading(**options), tuple(checked_keys.missing)


def _as_given(key: str, value: Any) -> Any:
    """Return the value of an option as in a config."""
    if key == "missing":
        return value if isinstance(value, list) else [value]
    return value if key == "skip_rows" else str(value)


def read_mapping(texts: Sequence[str]) -> dict[str, str]:
    """Read `VARIABLE=COLUMN` arguments.

    Raises
    ------
    ConfigError
        If an argument has another format, or a variable appears twice.
    """
    found: dict[str, str] = {}
    for text in texts:
        name, equals, column = (part.strip() for part in text.partition("="))
        if not equals or not name or not column:
            raise ConfigError(
                f"--map: must be VARIABLE=COLUMN, but is {text!r}; write it as in --map u='Voltage "
                "(V)'"
            )
        if name in found:
            raise ConfigError(
                f"--map: {name} must be given only one column, but is given {found[name]!r} and "
                f"{column!r}; remove one"
            )
        found[name] = column
    return found
