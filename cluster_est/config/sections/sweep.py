"""The keys of a sweep: which runs there are, as overrides of configs."""

from __future__ import annotations

import re
from pathlib import PurePath
from typing import Annotated, Any

from pydantic import BeforeValidator, Field
from pydantic_core import PydanticCustomError

from cluster_est.settings import ConfigSection

NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._+-]*[A-Za-z0-9])?")
"""Of runs, which are folders, and of what they are made of: usable on every file system."""


def value_name(value: Any) -> str:
    """Return the text of a plain value in the name of a run; "" where it needs its own name."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str | int | float):
        return re.sub(r"[^A-Za-z0-9._+-]", "_", str(value)).strip("._")
    return ""


def _configs(value: Any) -> Any:
    """A list of paths is short for a table with the files' names."""
    if not isinstance(value, list):
        return value
    if not all(isinstance(path, str) for path in value):
        raise PydanticCustomError("paths", "must be a list of paths in quotes")
    found = {PurePath(path).stem: path for path in value}
    if len(found) < len(value):
        raise PydanticCustomError(
            "paths", 'must have files of different names, or be a table: { NAME = "path" }'
        )
    return found


def _values(value: Any) -> Any:
    """A list of plain values is short for a table with themselves as names."""
    if not isinstance(value, list):
        return value
    named = {value_name(each): each for each in value}
    if "" in named or len(named) < len(value):
        raise PydanticCustomError(
            "values", "must be a list of different plain values, or a table: { NAME = value }"
        )
    return named


def _names(value: Any) -> Any:
    """One value, or several."""
    return [value_name(each) for each in (value if isinstance(value, list) else [value])]


class AxisSection(ConfigSection):
    """One axis of a sweep: values of a key, or sets of overrides."""

    name: str = Field(min_length=1, description="of the axis: a column of the summary")
    key: str = Field("", description='that its values are for, such as "method.seed"')
    values: Annotated[dict[str, Any], BeforeValidator(_values)] = Field(
        min_length=1,
        description="with key: a list of values, or { NAME = value }; "
        'without: { NAME = { "KEY" = value } }, overrides for each',
    )


class SingleRunSection(ConfigSection):
    """One run of a sweep besides the combinations."""

    name: str = Field(min_length=1, description="of the run: its folder")
    config: str = Field("", description="name of the config; needed where there are several")
    overrides: dict[str, Any] = Field(default_factory=dict, description='"KEY" = value')


class SweepSections(ConfigSection):
    """A whole sweep file."""

    configs: Annotated[dict[str, str], BeforeValidator(_configs)] = Field(
        min_length=1,
        description='paths of configs from the sweep\'s folder, or a table: { NAME = "path" }',
    )
    overrides: dict[str, Any] = Field(
        default_factory=dict, description='"KEY" = value, for every run'
    )
    axes: list[AxisSection] = Field(
        default_factory=list, description="every combination of their values is a run"
    )
    skip: list[dict[str, Annotated[list[str], BeforeValidator(_names)]]] = Field(
        default_factory=list, description="combinations to leave out: AXIS = value or values"
    )
    runs: list[SingleRunSection] = Field(
        default_factory=list, description="single runs besides the combinations"
    )
