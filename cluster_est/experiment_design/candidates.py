"""Candidate inputs: points of a cube, and the experiments that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.experiment_design.limits import ExperimentLimits, InputLimits, SignalLimits
from cluster_est.experiment_design.waveforms import LEVELS, WAVEFORMS
from workers.messages import Experiment, FloatArray, Input, Output, SignalBound

FREE_AMPLITUDES = 0.5
"""Share of the first candidates whose amplitude is drawn; the others have the largest."""
NEARLY = 0.9
"""Of the shortest duration that a recorded experiment must have."""
ORIGINS = ("random", "recorded", "improved")


@dataclass(frozen=True)
class CandidateInput:
    """A candidate for the next experiment.

    Attributes
    ----------
    name
        Such as "candidate 12".
    waveform
        Its name; "recorded" for the inputs of an earlier experiment.
    origin
        "random", "recorded" or "improved".
    experiment
        To be simulated: its outputs have no measured values yet.
    point
        Of the cube; empty for what was recorded.
    """

    name: str
    waveform: str
    origin: str
    experiment: Experiment = field(repr=False)
    point: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)


@dataclass(frozen=True)
class CandidateMaker:
    """Makes experiments of points, within limits.

    Attributes
    ----------
    limits
        Of the next experiment.
    like
        The experiment that it begins like.
    sigmas
        Standard deviation of the noise of each output, in its unit.
    waveforms
        Names of those that may be chosen.
    signals
        Limits of outputs and other variables: those that are given, and for the other outputs what
        the run has seen and a little more.
    """

    limits: ExperimentLimits
    like: Experiment
    sigmas: dict[str, float]
    waveforms: tuple[str, ...]
    signals: Mapping[str, SignalLimits]

    def size(self, waveform: str) -> int:
        """Coordinates of a point: of every input, then of start values, then the duration."""
        each = LEVELS + WAVEFORMS[waveform].size
        return each * len(self.limits.inputs) + len(self.limits.start) + 1

    def draw(self, number: int, generator: np.random.Generator) -> CandidateInput:
        """Draw a candidate: its waveform in turn, its point at random."""
        waveform = self.waveforms[number % len(self.waveforms)]
        point = generator.random(self.size(waveform))
        if generator.random() > FREE_AMPLITUDES:
            each = LEVELS + WAVEFORMS[waveform].size
            point[: each * len(self.limits.inputs) : each] = 1.0
        return self.make(f"candidate {number}", waveform, "random", point)

    def changed(
        self,
        candidate: CandidateInput,
        number: int,
        size: float,
        generator: np.random.Generator,
    ) -> CandidateInput:
        """Move some coordinates of a candidate; steps have this standard deviation."""
        point = candidate.point.copy()
        moved = generator.random(len(point)) < max(0.3, 2.0 / len(point))
        steps = size * generator.standard_normal(len(point))
        point = np.where(moved, point + steps, point)
        point = 1.0 - np.abs(1.0 - np.abs(point))  # reflected at the cube's faces
        point = np.clip(point, 0.0, 1.0)
        return self.make(f"candidate {number}", candidate.waveform, "improved", point)

    def shrunk(self, candidate: CandidateInput, number: int, factor: float) -> CandidateInput:
        """The same with smaller amplitudes."""
        point = candidate.point.copy()
        each = LEVELS + WAVEFORMS[candidate.waveform].size
        point[: each * len(self.limits.inputs) : each] *= factor
        return self.make(f"candidate {number}", candidate.waveform, "random", point)

    def make(self, name: str, waveform: str, origin: str, point: FloatArray) -> CandidateInput:
        """Make the candidate of a point."""
        limits = self.limits
        shortest, longest = limits.duration
        samples = 1 + round(
            (shortest + float(point[-1]) * (longest - shortest)) / limits.sample_time
        )
        times: FloatArray = limits.sample_time * np.arange(samples, dtype=np.float64)
        each = LEVELS + WAVEFORMS[waveform].size
        inputs = tuple(
            Input(
                variable,
                times,
                WAVEFORMS[waveform].signal(point[i * each : (i + 1) * each], times, one),
            )
            for i, (variable, one) in enumerate(limits.inputs.items())
        )
        own = point[each * len(limits.inputs) : -1]
        values = {
            variable: one.lower + float(share) * (one.upper - one.lower)
            for share, (variable, one) in zip(own, limits.start.items(), strict=True)
        }
        return CandidateInput(
            name, waveform, origin, self._experiment(name, times, inputs, values), point
        )

    def recorded(self, earlier: Experiment) -> CandidateInput | None:
        """Return the inputs of an earlier experiment as a candidate; None if they break limits."""
        limits = self.limits
        duration = min(earlier.stop - earlier.start, limits.duration[1])
        samples = 1 + int(duration / limits.sample_time + 1e-9)
        times: FloatArray = limits.sample_time * np.arange(samples, dtype=np.float64)
        known = {given.variable: given for given in earlier.inputs}
        if not set(limits.inputs) <= set(known) or duration < NEARLY * limits.duration[0]:
            return None
        inputs = []
        for variable, one in limits.inputs.items():
            given = known[variable]
            values = np.interp(times, given.times - earlier.start, given.values)
            if not _keeps(values, limits.sample_time, one):
                return None
            inputs.append(Input(variable, times, values))
        own = dict(earlier.values)
        values_chosen = {
            name: float(own[name])
            for name, one in limits.start.items()
            if isinstance(own.get(name), float | int) and one.lower <= own[name] <= one.upper  # type: ignore[operator]
        }
        if len(values_chosen) < len(limits.start):
            return None
        name = f"recorded {earlier.id}"
        made = self._experiment(name, times, tuple(inputs), values_chosen)
        return CandidateInput(name, "recorded", "recorded", made)

    def _experiment(
        self,
        name: str,
        times: FloatArray,
        inputs: tuple[Input, ...],
        values: dict[str, float],
    ) -> Experiment:
        like = self.like
        designed = {given.variable for given in inputs}
        kept = [
            replace(given, times=given.times - like.start)
            for given in like.inputs
            if given.variable not in designed
        ]
        nothing = np.zeros(len(times))
        return replace(
            like,
            id=name,
            record="",
            role="train",
            start=0.0,
            stop=float(times[-1]),
            inputs=(*inputs, *kept),
            signals=tuple(replace(s, times=s.times - like.start) for s in like.signals),
            outputs=tuple(
                Output(variable, times, nothing, sigma) for variable, sigma in self.sigmas.items()
            ),
            values=tuple((dict(like.values) | values).items()),
            bounds=tuple(_bounds(self.signals, times)),
            constraint_functions=(),
        )


def _keeps(values: FloatArray, step: float, limits: InputLimits) -> bool:
    """Whether a signal keeps the limits of its input."""
    fastest = float(np.abs(np.diff(values)).max(initial=0.0)) / step
    begins = limits.start is None or bool(np.isclose(values[0], limits.start))
    inside = limits.lower <= values.min() and values.max() <= limits.upper
    return bool(inside and begins and fastest <= limits.rate * (1.0 + 1e-9))


def _bounds(signals: Mapping[str, SignalLimits], times: FloatArray) -> Sequence[SignalBound]:
    found = []
    for variable, one in signals.items():
        sides = [each for each in (one.lower, one.upper) if np.isfinite(each)]
        scale = one.upper - one.lower if len(sides) == 2 else max(abs(sides[0]), 1e-9)
        found.append(
            SignalBound(
                f"signals.{variable}",
                variable,
                times,
                np.full(len(times), one.lower),
                np.full(len(times), one.upper),
                scale,
            )
        )
    return found
