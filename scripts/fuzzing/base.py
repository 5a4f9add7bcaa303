"""One input, and whether a user could live with what a command makes of it.

An input is files in a folder and the command that reads them; also values that surprise.
"""

from __future__ import annotations

import contextlib
import io
import os
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from cluster_est.cli import main

CONFIGS = Path(__file__).parent.parent.parent / "configs"
DATE = "2020-01-01T00:00:00Z"
"""Written without quotes, so that TOML reads a date."""


@dataclass(frozen=True)
class Input:
    """What one command is given.

    Attributes
    ----------
    kind
        What was spoiled: "config", "table", "description" or "archive" (of an FMU).
    arguments
        Of the command line, from the folder of the files.
    files
        (name, content).
    """

    kind: str
    arguments: tuple[str, ...]
    files: tuple[tuple[str, bytes], ...]


CHECK = ("check", "config.toml", "--seconds", "0")
FIT = (
    "fit", "config.toml", "--out", "out", "executor.name=local", "executor.workers=1",
    "budget.evaluations=20",
)  # fmt: skip
"""As small as a fit can be; no config may start another executor."""

COMMANDS = st.sampled_from([CHECK, CHECK, CHECK, FIT])

_NUMBERS = [
    0, 1, -1, 2, 3.5, 0.0, -0.0, 1e-9, 5e-324, -1e300, 1e9, 1e300, 2**31, 2**53 + 1, 2**63 - 1,
    2**63, -(2**63) - 1, 10**400, float("nan"), float("inf"), float("-inf"),
]  # fmt: skip
NUMBERS = st.sampled_from(_NUMBERS)
_TEXTS = [
    "", " ", ".", "..", "/", "~", "$HOME", "$NO_SUCH", "a" * 5000, "x\x00y", "\u202eabc", "\x7f",
    "ü", "時間", "der(v)", "m", "x", "v", "F", "y", "time", "position", "exp1", DATE, "m + ",
    "m**m**m", "__import__('os')", "1/0", "m <= k", "9" * 400, "(" * 300, "2**9**9**9",
    "pair x,v", "input F", "output y", "parameter m", "group:a", "experiment", "a:b", "coulomb",
    "backlash", "delay", "huber", "likelihood", "total", "de", "cmaes", "nsga2", "sqp",
    "nelder_mead", "pattern_search", "isres", "co_simulation", "rk4", "fmu", "union", "simulated",
    "both", "max", "range", "hold", "log", "test", "data", "data/x.csv",
]  # fmt: skip
TEXTS = st.one_of(
    st.text(max_size=5),
    st.sampled_from(_TEXTS),
)
SCALARS = st.one_of(NUMBERS, TEXTS, st.booleans())
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=4), inner, max_size=2)
    ),
    max_leaves=4,
)
"""What a key of a config may be given."""


def damaged(draw: Any, content: bytes) -> bytes:
    """Cut off, overwrite, repeat or insert bytes somewhere."""
    at = draw(st.integers(0, max(len(content) - 1, 0)))
    how = draw(st.sampled_from(["cut", "overwrite", "insert", "repeat", "remove", "empty"]))
    some = draw(st.binary(min_size=1, max_size=4))
    length = draw(st.integers(1, 64))
    damages: dict[str, bytes] = {
        "cut": content[:at],
        "overwrite": content[:at] + some + content[at + len(some) :],
        "insert": content[:at] + some + content[at:],
        "repeat": content[: at + length] + content[at:],
        "remove": content[:at] + content[at + length :],
        "empty": b"",
    }
    return damages[how]


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
    strays = [str(p) for p in found if p.parent != home or p.name not in ("fmus", "core")]
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
