"""Types of values in a config file."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, Strict
from pydantic_core import PydanticCustomError

LARGEST = 2**63 - 1
"""Of the integers that compiled code counts with."""
MOST_TIMES = 10_000_000
"""At which a signal may be looked at in one experiment: 80 MB of numbers."""


def _known(value: Any) -> Any:
    """A known value keeps its type: the FMU's variable decides which it must be."""
    largest = LARGEST if isinstance(value, int) else float("inf")
    if isinstance(value, str) and "\0" not in value:
        return value
    if isinstance(value, bool | int | float) and abs(value) < largest:
        return value
    raise PydanticCustomError("known", "must be a finite number, true, false or a text")


def as_column(value: Any) -> Any:
    """A column's name alone is short for a table with it."""
    if isinstance(value, str):
        return {"column": value}
    if isinstance(value, dict | BaseModel):
        return value
    raise PydanticCustomError("input", "must be a column's name or { column, interpolation }")


def as_group(value: Any) -> Any:
    """A label alone is short for a table with it."""
    if isinstance(value, str):
        return {"": value}
    if isinstance(value, dict):
        return value
    raise PydanticCustomError("group", 'must be a label or { KEY = "label" }')


def _free(value: Any) -> Any:
    """A scale or offset is known, one of each experiment, or one of all."""
    if isinstance(value, bool) or value == "shared":
        return value
    raise PydanticCustomError("free", 'must be true, false or "shared"')


def _ordinal(value: Any) -> Any:
    """Whether values say an order alone, or the words that do."""
    if isinstance(value, bool):
        return value
    several = isinstance(value, list | tuple) and len(value) > 1
    if several and all(isinstance(word, str) and word for word in value):
        return list(value)
    raise PydanticCustomError(
        "ordinal", "must be true, false or a list of at least two words, the lowest first,"
    )


Count = Annotated[int, Field(ge=0, le=LARGEST)]
Positive = Annotated[int, Field(gt=0, le=LARGEST)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Samples = Annotated[int, Field(gt=1, le=MOST_TIMES)]
Known = Annotated[float | int | bool | str, PlainValidator(_known)]
Free = Annotated[bool | Literal["shared"], PlainValidator(_free)]
Ordinal = Annotated[bool | list[str], PlainValidator(_ordinal)]
Pair = Annotated[tuple[Finite, Finite], Strict(False)]
"""TOML has lists, which strictly are no tuples."""


class ConfigSection(BaseModel):
    """A section of a config file: strict, frozen, without unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def one_of(names: Iterable[str]) -> str:
    """Return the description of a key that takes one of some names."""
    *first, last = names
    return f"{', '.join(first)} or {last}"
