"""Limits of the next experiment: what may be fed in, and what must not be left."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from cluster_est.errors import ProblemError
from cluster_est.toml import dotted
from workers.messages.checks import check_kind, check_name, check_number, is_number, shown

FEWEST_SAMPLES = 10
MOST_SAMPLES = 200_000


@dataclass(frozen=True)
class InputLimits:
    """Limits of an input that is designed.

    Attributes
    ----------
    lower, upper
        In the input's unit.
    rate
        Largest change in a second; infinite for none.
    start
        Value that it begins at; None for any.
    hold
        Seconds for which a level is held at least, and the shortest half period of a wave; 0 for
        four samples.

    Raises
    ------
    ProblemError
        If no signal can keep them.
    """

    lower: float
    upper: float
    rate: float = math.inf
    start: float | None = None
    hold: float = 0.0

    def check(self, where: str) -> None:
        """Refuse what no signal can keep; `where` opens the message."""
        _check_range(self.lower, self.upper, where)
        if not is_number(self.rate) or not self.rate > 0.0:
            raise ProblemError(
                f"{where}.rate: must be greater than 0 but is {shown(self.rate)}; leave the input "
                "out if it must not change"
            )
        check_number(self.hold, f"{where}.hold", ProblemError, least=0.0)
        if self.start is not None:
            check_number(self.start, f"{where}.start", ProblemError)
            if not self.lower <= self.start <= self.upper:
                raise ProblemError(
                    f"{where}.start: must lie between lower, {self.lower:g}, and upper, "
                    f"{self.upper:g}, but is {self.start:g}; change one"
                )


@dataclass(frozen=True)
class SignalLimits:
    """Limits that an output or another variable of the FMU must keep; infinite for none."""

    lower: float = -math.inf
    upper: float = math.inf

    def check(self, where: str) -> None:
        """Refuse limits that are none, or exclude each other; `where` opens the message."""
        if math.isnan(self.lower) or math.isnan(self.upper) or not self.lower < self.upper:
            raise ProblemError(
                f"{where}.lower: must be below upper, {self.upper:g}, but is {self.lower:g}; "
                "change one"
            )
        if math.isinf(self.lower) and math.isinf(self.upper):
            raise ProblemError(f"{where}: must have lower or upper but has neither; add one")


@dataclass(frozen=True)
class ExperimentLimits:
    """Limits of the next experiment.

    Attributes
    ----------
    inputs
        The inputs that are designed, by their names in the FMU. The others are those of `like`.
    duration
        Seconds; or the shortest and the longest, to be chosen.
    sample_time
        Seconds between two samples of what is fed in and of what will be measured.
    signals
        Outputs and other variables of the FMU that must stay within limits.
    like
        Name of the experiment that the next one begins like, and whose outputs will be measured;
        the first training experiment if empty.
    start
        Start values that may be chosen, each between two limits, by the FMU's names.

    Raises
    ------
    ProblemError
        If no experiment can keep them.
    """

    inputs: Mapping[str, InputLimits]
    duration: tuple[float, float]
    sample_time: float
    signals: Mapping[str, SignalLimits] = field(default_factory=dict)
    like: str = ""
    start: Mapping[str, SignalLimits] = field(default_factory=dict)

    def __post_init__(self) -> None:
        given = self.duration
        pair = tuple(given) if isinstance(given, Sequence) else (given, given)
        object.__setattr__(self, "duration", pair)
        self._check_times()
        for key, kind in (
            ("inputs", InputLimits), ("signals", SignalLimits), ("start", SignalLimits)
        ):  # fmt: skip
            limits = getattr(self, key)
            check_kind(limits, Mapping, key, ProblemError)
            for name, each in limits.items():
                check_name(name, f"{key}: a variable", ProblemError)
                check_kind(each, kind, f"{key}.{name}", ProblemError)
                each.check(f"{key}.{name}")
        if not self.inputs and not self.start:
            raise ProblemError(
                "inputs: must name at least one input that may be chosen, or start a start value, "
                "but there is neither; add [inputs.NAME] with lower and upper"
            )
        for name, each in self.start.items():
            _check_range(each.lower, each.upper, f"start.{name}")
        for name, each in self.inputs.items():
            if each.hold > self.duration[0]:
                raise ProblemError(
                    f"{dotted('inputs', name)}.hold: must be at most the duration, "
                    f"{self.duration[0]:g} s, "
                    f"but is {each.hold:g} s; change one"
                )

    def _check_times(self) -> None:
        for value in self.duration:
            check_number(value, "duration", ProblemError, above=0.0)
        if len(self.duration) != 2 or not self.duration[0] <= self.duration[-1]:
            raise ProblemError(
                "duration: must be seconds, or [shortest, longest], but is "
                f"{list(self.duration)}; change it"
            )
        check_number(self.sample_time, "sample_time", ProblemError, above=0.0)
        fewest, most = (each / self.sample_time for each in self.duration)
        if fewest < FEWEST_SAMPLES:
            raise ProblemError(
                f"sample_time: must leave at least {FEWEST_SAMPLES} samples in a duration of "
                f"{self.duration[0]:g} s but is {self.sample_time:g} s; change one"
            )
        if most > MOST_SAMPLES:
            raise ProblemError(
                f"sample_time: must give at most {MOST_SAMPLES:,} samples in a duration of "
                f"{self.duration[1]:g} s but is {self.sample_time:g} s; change one"
            )


def _check_range(lower: float, upper: float, where: str) -> None:
    check_number(lower, f"{where}.lower", ProblemError)
    check_number(upper, f"{where}.upper", ProblemError)
    if not lower < upper:
        raise ProblemError(
            f"{where}.lower: must be below upper, {upper:g}, but is {lower:g}; change one"
        )
