"""The keys of a map: a table of values over points, as parameters that belong together."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, Strict

from cluster_est.problem.effects.table_values import Monotone
from cluster_est.settings import ConfigSection, Finite


class MapSection(ConfigSection):
    """Keys of a one-dimensional map."""

    variables: list[str] = Field(
        min_length=2, description="the FMU's names of its values, in the order of the points"
    )
    points: list[Finite] = Field(
        min_length=2, description="where the values hold, increasing, in the unit of the abscissa"
    )
    start: Finite | list[Finite] = Field(
        description="where the estimation starts: a number, or one for each point"
    )
    bounds: Annotated[tuple[float, float], Strict(False)] = Field(
        (float("-inf"), float("inf")),
        description="[lower, upper] of every value; with slope_change of the first one, and of "
        "what the others may differ from it by in one interval",
    )
    slope_change: Finite | None = Field(
        None,
        gt=0.0,
        description="smoothness: standard deviation of the change of its slope over one unit of "
        "the abscissa, a prior; default: none; needs finite bounds",
    )
    monotone: Monotone = Field("", description="increasing or decreasing: a constraint")
    fixed: bool = Field(False, description="keep every value at its start")
    unit: str = Field("", description="of its values, for tables; default: the FMU's")
