import re
from dataclasses import dataclass
from pathlib import Path

from support.problems.springs import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "cluster_est" / "docs").glob("*.md"))]
_FENCED = re.compile(r"^```(\w*)(?: title=\"([^\"]*)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_COMMAND = re.compile(r"^    ((?:[A-Z_]+=\S+ )*cluster-est .*)$", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A fenced block: where it is, its language, its title, and its text."""

    page: Path
    line: int
    language: str
    title: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


def _blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    return [
        Block(page, text[: m.start()].count("\n") + 1, m.group(1), m.group(2) or "", m.group(3))
        for m in _FENCED.finditer(text)
    ]


BLOCKS = [block for page in PAGES for block in _blocks(page)]
COMMANDS = [
    (page.name, line)
    for page in PAGES
    for line in _COMMAND.findall(page.read_text(encoding="utf-8"))
]


def complete(block: Block) -> bool:
    """Whether a TOML block is a whole config."""
    return "[model]" in block.text and "[[experiments]]" in block.text
