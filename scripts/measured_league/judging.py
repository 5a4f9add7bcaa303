"""Whether a name is right: what is written down about each case."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatchcase
from pathlib import Path

JUDGEMENTS = Path(__file__).with_name("judgements.toml")


class Rightness(StrEnum):
    """How right a name is. A member's text is what the page says."""

    RIGHT = "right"
    ALIAS = "alias"
    WRONG = "physically wrong"
    OPEN = "to be judged"


@dataclass(frozen=True)
class Judgement:
    """A judgement of all effects whose names fit a pattern with * and ?, and the reason."""

    pattern: str
    rightness: Rightness
    why: str


@dataclass(frozen=True)
class CaseJudgements:
    """What is known of a case.

    Attributes
    ----------
    remark
        What to know before its figures are believed.
    names
        Judgements; the first that fits a name counts.
    """

    remark: str
    names: tuple[Judgement, ...]

    def of(self, name: str) -> Judgement:
        """The judgement of an effect by its name."""
        for each in self.names:
            if fnmatchcase(name, each.pattern):
                return each
        return Judgement(name, Rightness.OPEN, "no pattern of this case fits this name")

    def overall(self, names: Sequence[str]) -> Rightness | None:
        """The best rightness among names; None where there is no name."""
        found = {self.of(name).rightness for name in names}
        for rightness in (Rightness.RIGHT, Rightness.ALIAS, Rightness.OPEN, Rightness.WRONG):
            if rightness in found:
                return rightness
        return None


def read_judgements(file: Path = JUDGEMENTS) -> dict[str, CaseJudgements]:
    """Read the judgements of all cases, by the names of these."""
    tree = tomllib.loads(file.read_text(encoding="utf-8"))
    return {
        case: CaseJudgements(
            section["remark"],
            tuple(
                Judgement(each["pattern"], Rightness(each["is"]), each["why"])
                for each in section.get("names", [])
            ),
        )
        for case, section in tree.items()
    }
