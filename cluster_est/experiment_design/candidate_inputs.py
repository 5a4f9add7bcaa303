"""Candidate inputs: points of a unit cube, and the experiments made from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.experiment_design.limits import ExperimentLimits, InputLimits, SignalLimits
from cluster_est.experiment_design.waveforms import LEVEL_COORDINATES, WAVEFORMS
from workers.grid import values_at
from workers.messages import Experiment, FloatArray, Input, Output, SignalBound

FREE_AMPLITUDES = 0.5
"""Share of the first candidates with a random amplitude; the others have the largest amplitude."""
RANDOM, RECORDED, IMPROVED, SMALLER_AMPLITUDES = "random", "recorded", "improved", "smaller"
"""Origins of candidates."""
NO_WAVEFORM = "start values"
"""Name of the waveform if no input is designed."""


@dataclass(frozen=True)
class CandidateInput:
    """A candidate for the next experiment.

    Attributes
    ----------
    name
        Such as "candidate 12".
    waveform
        Name of the waveform; "recorded" for the inputs of an earlier experiment.
    origin
        "random", "smaller" for a random candidate with reduced amplitudes, "recorded" or
        "improved".
    experiment
        The experiment to simulate; its outputs have no measured values yet.
    point
        Point of the cube; empty for a recorded input.
    """

    name: str
    waveform: str
    origin: str
    experiment: Experiment = field(repr=False)
    point: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)


@dataclass(frozen=True)
class CandidateMaker:
    """Makes experiments from points of the cube, within limits.

    Attributes
    ----------
    limits
        Limits of the next experiment.
    like
        The experiment whose start the next experiment has.
    sigmas
        Standard deviation of the noise of each output, in its unit.
    waveforms
        Names of the waveforms to choose from.
    signals
        Limits of outputs and other variables: the given limits, and for other outputs an extended
        range of the run's measurements.
    whole
        Names of the inputs that accept only integers.
    """

    limits: ExperimentLimits
    like: Experiment
    sigmas: dict[str, float]
    waveforms: tuple[str, ...]
    signals: Mapping[str, SignalLimits]
    whole: frozenset[str] = frozenset()

    def size(self, waveform: str) -> int:
        """Return the number of coordinates of a point: inputs, start values, duration."""
        return self._each(waveform) * len(self.limits.inputs) + len(self.limits.start) + 1

    def draw(self, number: int, generator: np.random.Generator) -> CandidateInput:
        """Draw a random candidate; waveforms alternate."""
        waveform = self.waveforms[number % len(self.waveforms)]
        point = generator.random(self.size(waveform))
        if generator.random() > FREE_AMPLITUDES:
            point[self._amplitudes(waveform)] = 1.0
        return self.make(f"candidate {number}", waveform, RANDOM, point)

    def changed(
        self,
        candidate: CandidateInput,
        number: int,
        size: float,
        generator: np.random.Generator,
    ) -> CandidateInput:
        """Change some coordinates of a candidate; steps have standard deviation `size`."""
        point = candidate.point.copy()
        moved = generator.random(len(point)) < max(0.3, 2.0 / len(point))
        steps = size * generator.standard_normal(len(point))
        point = np.where(moved, point + steps, point)
        point = 1.0 - np.abs(1.0 - np.abs(point))  # reflected at the faces of the cube
        point = np.clip(point, 0.0, 1.0)
        return self.make(f"candidate {number}", candidate.waveform, IMPROVED, point)

    def shrunk(self, candidate: CandidateInput, number: int, factor: float) -> CandidateInput:
        """Return a candidate with its amplitudes reduced."""
        point = candidate.point.copy()
        point[self._amplitudes(candidate.waveform)] *= factor
        return self.make(f"candidate {number}", candidate.waveform, SMALLER_AMPLITUDES, point)

    def make(self, name: str, waveform: str, origin: str, point: FloatArray) -> CandidateInput:
        """Return the candidate of a point."""
        limits = self.limits
        shortest, longest = limits.duration
        times = self._times(shortest + float(point[-1]) * (longest - shortest))
        each = self._each(waveform)
        inputs, how = [], {given.variable: given.interpolation for given in self.like.inputs}
        for i, (variable, one) in enumerate(limits.inputs.items()):
            own = point[i * each : (i + 1) * each]
            values = WAVEFORMS[waveform].signal(own, times - times[0], one)
            values = np.rint(values) if variable in self.whole else values
            inputs.append(Input(variable, times, values, how[variable]))
        own = point[each * len(limits.inputs) : -1]
        starts = {
            variable: one.lower + float(share) * (one.upper - one.lower)
            for share, (variable, one) in zip(own, limits.start.items(), strict=True)
        }
        made = self._experiment(name, times, inputs, starts)
        return CandidateInput(name, waveform if inputs else NO_WAVEFORM, origin, made, point)

    def recorded(self, earlier: Experiment) -> CandidateInput | None:
        """Return the inputs of an earlier experiment as a candidate; None outside the limits."""
        limits = self.limits
        shortest, longest = limits.duration
        times = self._times(min(earlier.stop - earlier.start, longest))
        known = {given.variable: given for given in earlier.inputs}
        missing = not limits.inputs or not set(limits.inputs) <= set(known)
        if missing or times[-1] - times[0] < shortest - 1.5 * limits.sample_time:
            return None
        inputs = []
        for variable, one in limits.inputs.items():
            given = known[variable]
            values = values_at(given, times - self.like.start + earlier.start)
            if not _keeps(values, limits.sample_time, one):
                return None
            inputs.append(Input(variable, times, values, given.interpolation))
        own = dict(earlier.values)
        starts = {}
        for name, between in limits.start.items():
            value = own.get(name)
            if not isinstance(value, float | int) or not between.lower <= value <= between.upper:
                return None
            starts[name] = float(value)
        name = f"recorded {earlier.id}"
        return CandidateInput(
            name, RECORDED, RECORDED, self._experiment(name, times, inputs, starts)
        )

    def _each(self, waveform: str) -> int:
        return LEVEL_COORDINATES + WAVEFORMS[waveform].size

    def _amplitudes(self, waveform: str) -> slice:
        """Return the positions of the amplitudes of all inputs in a point."""
        each = self._each(waveform)
        return slice(0, each * len(self.limits.inputs), each)

    def _times(self, duration: float) -> FloatArray:
        """Return the times of the samples, from the start of `like` on."""
        samples = 1 + int(duration / self.limits.sample_time + 0.5)
        times: FloatArray = np.arange(samples, dtype=np.float64)
        return self.like.start + self.limits.sample_time * times

    def _experiment(
        self, name: str, times: FloatArray, inputs: Sequence[Input], starts: Mapping[str, float]
    ) -> Experiment:
        designed = {given.variable for given in inputs}
        nothing = np.zeros(len(times))
        return replace(
            self.like,
            id=name,
            record="",
            own_starts=(),
            role="train",
            stop=float(times[-1]),
            inputs=(*inputs, *(g for g in self.like.inputs if g.variable not in designed)),
            outputs=tuple(
                Output(variable, times, nothing, sigma) for variable, sigma in self.sigmas.items()
            ),
            values=tuple({**dict(self.like.values), **starts}.items()),
            bounds=tuple(_bounds(self.signals, times)),
            constraint_functions=(),
        )


def _keeps(values: FloatArray, step: float, limits: InputLimits) -> bool:
    """Return whether a signal satisfies the limits of its input."""
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
