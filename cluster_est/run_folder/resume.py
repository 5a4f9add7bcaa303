"""Conditions for resuming an interrupted run."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from cluster_est.errors import RunFolderError
from cluster_est.run_folder.log_segment import read_segment, segments
from cluster_est.run_folder.run_files import (
    RunStatus,
    read_config_text,
    read_facts,
    read_run_columns,
)
from cluster_est.run_folder.run_folder import check_free
from cluster_est.run_folder.run_identity import DECISIVE, FORMAT, UNHASHED, RunIdentity, versions
from cluster_est.run_folder.run_progress import PROGRESS, ProgressTail

FINAL_TABLES = ("parameters", "ranking", "next_input")
"""Tables of which every finished run has at least one."""


def is_finished(out: Path) -> bool:
    """Return whether a folder contains a finished run without damage."""
    return (
        (out / "run.json").is_file()
        and any((out / f"{name}.parquet").is_file() for name in FINAL_TABLES)
        and read_facts(out)["status"] == RunStatus.DONE
        and is_whole(out)
    )


def is_whole(out: Path) -> bool:
    """Return whether all files of a finished run are undamaged."""
    try:
        read_config_text(out)
        progress = ProgressTail(out / PROGRESS)
        progress.new()
        progress.check()
        for path in out.glob("*.parquet"):
            read_run_columns(path)
        for path in segments(out / "evaluations"):
            read_segment(path)[0].check(path, ended=True)
    except RunFolderError:
        return False
    return True


def check_resumable(out: Path, identity: RunIdentity) -> bool:
    """Return whether there is a run to resume; otherwise the folder is free for a new run.

    Executor, budget and log may have changed. The evaluations of a budget include those of the
    first run, but its seconds start anew.

    Raises
    ------
    RunFolderError
        If the folder contains other files, or a run of another problem.
    """
    if not (out / "run.json").is_file():
        check_free(out, overwrite=False)
        return False
    facts = read_facts(out)
    different = _difference(out, facts, identity)
    if different:
        raise RunFolderError(
            f"{out}: --resume can only continue a run of the same problem, but {different}; choose "
            "another --out, or start again with --overwrite"
        )
    return True


def _difference(out: Path, facts: dict[str, Any], identity: RunIdentity) -> str:
    """Return how the existing run differs, as part of a sentence; empty if it does not."""
    problem = identity.problem
    if facts.get("format") != FORMAT:
        return (
            f"its format is {facts.get('format')}, and this version of cluster-est writes {FORMAT}"
        )
    if facts.get("config_hash") != identity.config_hash:
        return _different_key(out, identity)
    if facts.get("fmu", {}).get("sha256") != problem.model.archive_hash:
        return f"the FMU {problem.model.name} had other contents then"
    known = facts.get("experiments", {})
    for experiment in problem.experiments:
        if known.get(experiment.id) != experiment.key:
            return f"the data of experiment {experiment.id!r} were different then"
    return _different_version(facts.get("versions", {}))


def _different_key(out: Path, identity: RunIdentity) -> str:
    try:
        before = tomllib.loads(read_config_text(out))
    except (RunFolderError, ValueError):
        before = {}
    now = tomllib.loads(identity.config_text)
    for tree in (before, now):
        for section in (*UNHASHED, *identity.kind.unused_sections):
            tree.pop(section, None)
    key = _first_difference(before, now)
    if not key:
        return "it was started by another command"
    was, is_now = (_at(tree, key) for tree in (before, now))
    return f"{'.'.join(key)} was {was} then and is {is_now} now"


def _first_difference(before: Any, now: Any) -> tuple[str, ...]:
    """Return the path to the first value that differs; empty if none does."""
    pairs: list[tuple[str, Any, Any]] = []
    if isinstance(before, dict) and isinstance(now, dict):
        pairs = [(k, before.get(k), now.get(k)) for k in dict.fromkeys([*before, *now])]
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = [(str(i), *pair) for i, pair in enumerate(zip(before, now, strict=True))]
    for name, one, other in pairs:
        if one != other:
            return (name, *_first_difference(one, other))
    return ()


def _at(tree: Any, key: tuple[str, ...]) -> str:
    for part in key:
        tree = tree[int(part)] if isinstance(tree, list) else tree.get(part)
    text = "not there" if tree is None else repr(tree)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _different_version(before: dict[str, str]) -> str:
    """Return a difference in software that may change bits; Python's patch level is ignored."""
    now = versions()
    for name in ("platform", *DECISIVE):
        if before.get(name) != now.get(name):
            return f"{name} was {before.get(name)} then and is {now.get(name)} now"
    was, is_now = str(before.get("python")), now["python"]
    if was.split(".")[:2] != is_now.split(".")[:2]:
        return f"python was {was} then and is {is_now} now"
    return ""
