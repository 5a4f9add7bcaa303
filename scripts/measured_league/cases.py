"""The cases of the league: a base model's config, what a textbook changes in it, and its data."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cluster_est.toml import to_toml

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"

Tree = dict[str, Any]


@dataclass(frozen=True)
class LeagueCase:
    """A measured set with a base model.

    Attributes
    ----------
    name
        That of its config.
    config
        The base model and the frozen split.
    textbook
        What the textbook changes: effects, or another model with further parameters. None of a
        case on an official split, which stands beside published errors instead.
    """

    name: str
    config: Path
    textbook: Path | None = None

    @property
    def title(self) -> str:
        """What was measured: the comment that opens the config, up to its source."""
        return _opening(self.config).split(": ")[0] + "."

    @property
    def lacking(self) -> str:
        """The effect that the base model lacks, in the words of the textbook's file."""
        return _opening(self.textbook) if self.textbook else ""


def all_cases(configs: Path = CONFIGS) -> tuple[LeagueCase, ...]:
    """Every case that has a textbook's file, in the order of their names.

    Its base model is that of the league's own config, or else of an example of the same name.
    """
    league = configs / "league"
    return tuple(
        LeagueCase(path.stem, _config(path.name, league, configs), path)
        for path in sorted((league / "textbook").glob("*.toml"))
    )


def official_cases(configs: Path = CONFIGS) -> tuple[LeagueCase, ...]:
    """Every case on the split of nonlinearbenchmark.org, whose page gives start windows as well."""
    return tuple(
        LeagueCase(f"official_{path.stem}", path)
        for path in sorted((configs / "league" / "official").glob("*.toml"))
    )


def _config(name: str, league: Path, examples: Path) -> Path:
    own = league / name
    return own if own.is_file() else examples / name


def textbook_config(case: LeagueCase) -> str:
    """The whole config of the textbook's model, on the data and the split of the base model.

    Paths in it are absolute, so it may stand in any folder.
    """
    base = with_absolute_paths(read(case.config), case.config.parent)
    if case.textbook is None:
        raise ValueError(f"{case.name} has no textbook's model")
    change = with_absolute_paths(read(case.textbook), case.textbook.parent)
    return to_toml(changed(base, change))


def read(config: Path) -> Tree:
    """The tree of a TOML file."""
    return tomllib.loads(config.read_text(encoding="utf-8"))


def with_absolute_paths(tree: Tree, folder: Path) -> Tree:
    """A config's tree whose paths no longer depend on its folder."""
    found = dict(tree)
    if "model" in tree:
        fmu = str((folder / tree["model"]["fmu"]).resolve())
        found["model"] = tree["model"] | {"fmu": fmu}
    if "data_folders" in tree:
        found["data_folders"] = [
            each if each.startswith("$") else str((folder / each).resolve())
            for each in tree["data_folders"]
        ]
    return found


def changed(base: Mapping[str, Any], change: Mapping[str, Any]) -> Tree:
    """A tree with another put over it: tables key by key, experiments by their ids."""
    found = dict(base)
    for key, value in change.items():
        old = base.get(key)
        if key == "experiments" and isinstance(old, list):
            found[key] = _experiments(old, value)
        elif isinstance(old, dict) and isinstance(value, dict):
            found[key] = changed(old, value)
        else:
            found[key] = value
    return found


def _experiments(old: Sequence[Tree], change: Sequence[Tree]) -> list[Tree]:
    changes = {each["id"]: each for each in change}
    unknown = set(changes) - {each["id"] for each in old}
    if unknown:
        raise ValueError(f"the textbook names experiments that the base lacks: {sorted(unknown)}")
    return [changed(each, changes.get(each["id"], {})) for each in old]


def _opening(config: Path) -> str:
    """The comment that opens a file, up to its first empty line."""
    words = []
    for line in config.read_text(encoding="utf-8").splitlines():
        if not line.startswith("# "):
            break
        words.append(line.removeprefix("# "))
    return " ".join(words)


Row = list[str]


def convert(source: Path, target: Path) -> list[Path]:
    """Write the tables of all sets that need one and are there.

    Parameters
    ----------
    source
        The folder of the measured data, which holds `league`.
    target
        The folder to write to; the same folders are made in it.

    Returns
    -------
    list of Path
        The tables that were written.
    """
    written = []
    for before, (after, change) in CONVERSIONS.items():
        if (source / before).is_file():
            rows = (source / before).read_text(encoding="utf-8").split()
            table = change([row.split(",") for row in rows])
            path = target / after
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("".join(f"{','.join(row)}\n" for row in table), encoding="utf-8")
            written.append(path)
    return written


def without_repeated_times(rows: Iterable[Row]) -> list[Row]:
    """Leave out each row whose first cell is that of the row before."""
    kept: list[Row] = []
    for row in rows:
        if not kept or row[0] != kept[-1][0]:
            kept.append(row)
    return kept


def with_logarithm(rows: Iterable[Row]) -> list[Row]:
    """Put the decimal logarithm in the place of the second column."""
    head, *body = rows
    logged = [[time, repr(math.log10(float(value)))] for time, value in body]
    return [[head[0], f"lg{head[1]}"], *logged]


CONVERSIONS: dict[str, tuple[str, Callable[[Iterable[Row]], list[Row]]]] = {
    "league/battery/hppc.csv": ("league/battery/once.csv", without_repeated_times),
    "league/hiv/hiv.csv": ("league/hiv/lgV.csv", with_logarithm),
}
"""A measured file, the table that is made of it, and how."""
