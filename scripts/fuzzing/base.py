"""One input: files in a folder and the command that reads them; and values that surprise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

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
