"""The benches, a file for each; `bench.py` runs them by their names.

A bench has `OPTIONS`, its own options with their defaults, and `rows`, which takes all options and
yields the rows of its table. A value of an option that is a list takes several words, and one that
is False is a switch. What it measures and what its options mean stands in its docstring.
"""

from __future__ import annotations

Value = str | int | float | bool
Row = dict[str, Value]
"""One line of a table, by the heads of its columns."""
