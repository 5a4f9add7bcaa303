"""Parameters: the values to estimate."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from cluster_est.errors import ProblemError
from cluster_est.problem.distribution_prior import as_prior
from cluster_est.problem.priors import Prior
from cluster_est.toml import dotted
from workers.messages.checks import (
    check_choice,
    check_flag,
    check_kind,
    check_name,
    check_number,
    check_text,
    is_finite,
    is_number,
    shown,
    told_apart,
)

Scale = Literal["linear", "log"]


@dataclass(frozen=True)
class Parameter:
    """A value to estimate: a parameter of the model or an initial state.

    Attributes
    ----------
    name
        The user's name for the parameter.
    start
        Start value of the estimation; the value itself if `fixed`.
    bounds
        (lower, upper), in the same physical unit as `start`; infinite if there is no bound.
    scale
        "log" for a positive value whose order of magnitude is uncertain: methods then search its
        logarithm.
    fixed
        Whether the parameter keeps its start value.
    variable
        The FMU's name for the parameter; `name` if empty.
    per
        None: one value for all experiments. "experiment": one for each experiment. "group:KEY": one
        for each label that the experiments have under KEY. "gap": the start value, but one
        estimated value for each part of a record that begins after a gap.
    unit
        Unit for tables; filled in from the FMU if empty.
    expression
        A formula in other parameters, such as "2 * k1". The value is computed and not estimated.
        Its bounds become constraints.
    auxiliary
        Whether only expressions and constraints use the parameter, which the FMU does not have.
    prior
        Knowledge of the parameter before the measurements; with `per`, of each of its values. It
        may be given as a frozen distribution of `scipy.stats` with one mode. None: only the bounds.
    """

    name: str
    start: float
    bounds: tuple[float, float] = (-math.inf, math.inf)
    scale: Scale = "linear"
    fixed: bool = False
    variable: str = ""
    per: str | None = None
    unit: str = ""
    expression: str = ""
    auxiliary: bool = False
    prior: Prior | None = None

    def __post_init__(self) -> None:
        check_name(self.name, "parameters.name", ProblemError)
        where = dotted("parameters", self.name)
        self._check_kinds(where)
        if not self.lower < self.upper:
            low, high = told_apart(self.lower, self.upper)
            raise ProblemError(
                f"{where}.bounds: the lower bound must be below the upper bound, but they are "
                f"[{low}, {high}]; to keep the value constant, use fixed = true"
            )
        if self.expression:
            self._check_derived(where)
        elif not self.lower <= self.start <= self.upper:
            low, high, start = told_apart(self.lower, self.upper, self.start)
            raise ProblemError(
                f"{where}.start: must lie within the bounds [{low}, {high}], but is {start}; move "
                "the start or widen the bounds"
            )
        if self.scale == "log" and (self.start <= 0.0 or self.upper <= 0.0):
            raise ProblemError(
                f"{where}.scale: a log scale needs a positive start and upper bound, but they are "
                f'{self.start:g} and {self.upper:g}; use scale = "linear" or positive values'
            )
        per = str(self.per)
        if self.per is not None and not re.fullmatch("experiment|gap|group(:.+)?", per):
            raise ProblemError(
                f'{where}.per: must be "experiment" or "group:KEY", but is {self.per!r}'
            )

        if self.prior is not None:
            object.__setattr__(self, "prior", as_prior(self.prior, f"{where}.prior"))
            self._check_prior(where)

    def _check_prior(self, where: str) -> None:
        check_kind(self.prior, Prior, f"{where}.prior", ProblemError)
        assert self.prior is not None
        for key, used in (("fixed", self.fixed), ("expression", bool(self.expression))):
            if used:
                raise ProblemError(
                    f"{where}.prior: must not be used with {key}, because the value is not "
                    "estimated; remove one of the two"
                )
        self.prior.check(where, self.start, self.lower, self.upper)

    def _check_kinds(self, where: str) -> None:
        check_number(self.start, f"{where}.start", ProblemError)
        self._check_bounds(where)
        check_choice(self.scale, get_args(Scale), f"{where}.scale", ProblemError)
        for key in ("variable", "unit", "expression"):
            check_text(getattr(self, key), f"{where}.{key}", ProblemError)
        for key in ("fixed", "auxiliary"):
            check_flag(getattr(self, key), f"{where}.{key}", ProblemError)

    def _check_bounds(self, where: str) -> None:
        given: Any = self.bounds
        if not isinstance(given, Sequence) or isinstance(given, str) or len(given) != 2:
            raise ProblemError(
                f"{where}.bounds: must be (lower, upper), but is {shown(given)}; write "
                "bounds=(0.1, 10.0)"
            )
        for key, bound in zip(("lower", "upper"), given, strict=True):
            if not is_number(bound) or (isinstance(bound, int) and not is_finite(bound)):
                raise ProblemError(
                    f"{where}.bounds: {key} must be a number, or infinite for no bound, but is "
                    f"{shown(bound)}"
                )
        object.__setattr__(self, "bounds", tuple(given))

    def _check_derived(self, where: str) -> None:
        for key, used in (("fixed", self.fixed), ("per", self.per), ("scale", self.scale == "log")):
            if used:
                raise ProblemError(
                    f"{where}.{key}: must not be used with expression, which gives the value; "
                    "remove one of the two"
                )

    @property
    def lower(self) -> float:
        """The lower bound."""
        return self.bounds[0]

    @property
    def upper(self) -> float:
        """The upper bound."""
        return self.bounds[1]

    @property
    def target(self) -> str:
        """The FMU's variable."""
        return self.variable or self.name
