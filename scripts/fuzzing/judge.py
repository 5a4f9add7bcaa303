"""Runs a command on an input and says whether a user could live with what came of it."""

from __future__ import annotations

import contextlib
import io
import os
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path

from cluster_est.cli import main
from fuzzing.base import CONFIGS, Input

ALLOWED = (0, 1, 2)


@dataclass(frozen=True)
class Verdict:
    """What a command did with an input.

    Attributes
    ----------
    code
        Its exit code; None if there was none.
    seconds
        How long it took.
    said
        What it wrote to stderr.
    fault
        What it must not do but did; empty if there is nothing.
    """

    code: int | None
    seconds: float
    said: str
    fault: str


def write(given: Input, folder: Path) -> None:
    """Write the input's files beside this project's models and data."""
    for name in ("models", "data"):
        (folder / name).symlink_to(CONFIGS / name)
    for name, content in given.files:
        (folder / name).write_bytes(content)


def judge(given: Input, folder: Path) -> Verdict:
    """Run the input's command in a folder with its files; warnings count as faults."""
    out, err = io.StringIO(), io.StringIO()
    files = sorted(folder.rglob("*"))
    before, begin = os.getcwd(), time.monotonic()
    code: int | None = None
    fault = ""
    os.chdir(folder)
    try:
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("error")
            code = main(given.arguments)
    except BaseException:  # whatever comes out is what is looked for
        fault = traceback.format_exc()
    finally:
        os.chdir(before)
    seconds, said = time.monotonic() - begin, err.getvalue()
    if not fault and code == 2 and sorted(folder.rglob("*")) != files:
        fault = "exit code 2, but files were written"
    return Verdict(code, seconds, said, fault or _strays() or _fault(code, said))


def _strays() -> str:
    """What an archive wrote outside its own folder, which is named by a hash, as its mark is."""
    home = Path(os.environ["CLUSTER_EST_CACHE"])
    found = [p for p in (*home.glob("*"), *home.glob("fmus/*")) if len(p.stem) != 64]
    strays = [str(p) for p in found if p != home / "fmus"]
    return f"written outside of an FMU's folder: {', '.join(strays)}" if strays else ""


def _fault(code: int | None, said: str) -> str:
    if code not in ALLOWED:
        return f"exit code {code}"
    if "Traceback" in said:
        return "a traceback in what it said"
    if code != 2:
        return ""
    lines = said.removesuffix("\n").split("\n")
    if not said.startswith("cluster-est: ") or any(len(line.split()) < 4 for line in lines):
        return "exit code 2 without a sentence on each line"
    if not all(line.isprintable() for line in lines):
        return "a sentence with what a terminal would obey"
    if max(map(len, lines)) > 3000:
        return "a sentence that nobody reads to its end"
    return ""
