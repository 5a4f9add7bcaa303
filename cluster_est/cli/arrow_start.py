"""The start of pyarrow without pandas, which it would import with its first array.

It does so to know a column of pandas when it is given one. No command is, and where pandas is
installed this takes a quarter of a second. Whoever asks pyarrow for pandas later still gets it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from types import ModuleType

from typing_extensions import override


class _WithoutPandas(MetaPathFinder):
    """Finds no pandas, and leaves everything else to others."""

    @override
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> None:
        if fullname == "pandas":
            raise ModuleNotFoundError(fullname)


def start_arrow() -> None:
    """Have pyarrow make its first array while pandas cannot be found."""
    if "pandas" in sys.modules:
        return
    import pyarrow as pa

    finder = _WithoutPandas()
    sys.meta_path.insert(0, finder)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(finder)
