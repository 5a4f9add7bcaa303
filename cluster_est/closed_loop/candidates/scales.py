"""Ranges of the coefficients of a form, derived from the signals in the data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from workers.effects.forms import EffectForm, FormCoefficient, FormCondition, GridScale
from workers.effects.site import EffectSite, split_variable
from workers.messages import FloatArray

BOTH_SIGNS = 0.15
"""Share of its rms that a signal must reach on both sides of zero to count as oscillating.
Benchmark."""

TURNS = 0.15
"""Share of its range by which a signal must both rise and fall within one experiment to count as
turning back. By definition, like `BOTH_SIGNS`: far above noise and the overshoot of a step."""

SHORTEST_TIME = 0.1
"""Smallest time constant, of a lag or of a state that acts on its own derivative, as a share of the
interval between measurements, or of the communication step if that is longer. Signal: for the data,
a shorter lag is a gain and a steeper slope is a hard stop, and the number of solver steps grows in
proportion (at a twentieth, a simulation of two tanks takes 40 times as long)."""


@dataclass(frozen=True)
class SignalScales:
    """Sizes of all signals over all training experiments.

    `communication` is the communication step of the FMU; it is 0.0 if the FMU exchanges its signals
    at all times of the data. `step` is the step of a solver that does not shorten its step at a
    switch; it is 0.0 for other solvers. `units` are the units of the FMU's variables.
    """

    trajectories: Sequence[LinearisedTrajectory]
    frequencies: Sequence[float]
    communication: float = 0.0
    step: float = 0.0
    units: Mapping[str, str] = field(default_factory=dict)

    def allow(self, form: EffectForm, site: EffectSite, variables: tuple[str, ...]) -> bool:
        """Return whether a form makes sense for these signals."""
        about = self._about(site, variables)
        if FormCondition.FROM_REST in form.when and not self._begins(site.target):
            return False
        if FormCondition.REVERSES in form.when and not self._reverses(site.target):
            return False
        moving = variables[:1] if FormCondition.AROUND in form.when else variables
        others = [self._pooled(name) for name in moving[1:]]
        if about is not None and not all(_moves(signal) for signal in (about, *others)):
            return False
        if FormCondition.OSCILLATES in form.when and (about is None or not oscillates(about)):
            return False
        if FormCondition.POSITIVE in form.when and (about is None or not _positive(about)):
            return False
        if FormCondition.AMOUNT in form.when and not self._is_amount(about, variables):
            return False
        spread = [c.scale for c in form.coefficients if c.scale in _ENDS]
        ends = {self.grid(FormCoefficient("", scale=scale), site, variables) for scale in spread}
        return len(ends) == len(spread)

    def grid(
        self, coefficient: FormCoefficient, site: EffectSite, variables: tuple[str, ...]
    ) -> tuple[float, ...]:
        """Return the values of a coefficient to try."""
        scale = coefficient.scale
        if scale is GridScale.SPECTRUM:
            return tuple(self.frequencies)
        grid = coefficient.grid or (1.0,)
        if scale in _AS_THEY_ARE:
            return grid
        if scale is GridScale.ABSOLUTE_ZERO:
            above = _ABOVE_ZERO.get(self.units.get(variables[0], ""))
            return () if above is None else (above,)
        if scale is GridScale.STEP:
            return tuple(g * self.resolution for g in grid)
        if scale is GridScale.PER_STEP:
            return tuple(g / self.resolution for g in grid)
        if scale is GridScale.MIDDLE_T:
            middle = np.mean([0.5 * (c.times[0] + c.times[-1]) for c in self.trajectories])
            return tuple(g * float(middle) for g in grid)
        if scale is GridScale.COUPLING:
            return tuple(g * self._coupling(site) for g in grid)
        signal = self._scaled_by(scale, site, variables)
        if signal is None:
            return ()
        values = self._spread(scale or GridScale.RMS_V, np.array(grid), signal, site, variables)
        if coefficient.held and coefficient.positive and self.step and variables:
            return tuple(dict.fromkeys(np.maximum(values, self._crossed(variables[0])).tolist()))
        return tuple(float(x) for x in values)

    def _scaled_by(
        self, scale: GridScale | None, site: EffectSite, variables: tuple[str, ...]
    ) -> FloatArray | None:
        """The signal from whose size a scale is computed."""
        if scale in _OF_SECOND:
            return self._pooled(variables[1])
        return self._signal(site) if scale in _OF_SIGNAL else self._about(site, variables)

    def _spread(
        self,
        scale: GridScale,
        rates: FloatArray,
        signal: FloatArray,
        site: EffectSite,
        variables: tuple[str, ...],
    ) -> FloatArray:
        """Values of a coefficient, spread over the range or the rates of a signal."""
        if scale is GridScale.QUANTILE_V:
            return np.asarray(np.quantile(signal, rates))
        if scale is GridScale.RANGE_S:
            return np.asarray(signal.min() + rates * (signal.max() - signal.min()))
        if scale is GridScale.TRAVEL_V:
            return rates * self._travel(variables[0])
        if scale is GridScale.WAVES_V:
            return _waves(rates, float(np.ptp(signal)))
        if scale is GridScale.WAVES_TRAVEL_V:
            return _waves(rates, float(np.ptp(np.concatenate(self._ways(variables[0])))))
        if scale is GridScale.FASTEST_S:
            return rates * self._fastest(site.target)
        return np.asarray(rates * _SIZES[scale](signal))

    def steepest(self, state: str, variable: str) -> float:
        """Return the largest slope of a state's own derivative that data can tell from a hard stop.

        A slope s of der(x) over x is a time constant 1 / s. If it is far shorter than the
        resolution and than the model's own time constant, the state only stays at the stop, and
        the solver takes many small steps. Infinite if the variable does not contain the state.
        """
        if state not in split_variable(variable, self.trajectories[0].signals):
            return np.inf
        linears = [each.linear for each in self.trajectories if each.linear is not None]
        places = [linear.state_names.index(state) for linear in linears]
        pairs = zip(linears, places, strict=True)
        rates = [float(np.abs(linear.A.row(place)[:, place]).max()) for linear, place in pairs]
        return max(1.0 / self.resolution, *rates, 0.0) / SHORTEST_TIME

    def _is_amount(self, about: FloatArray | None, variables: tuple[str, ...]) -> bool:
        warm = bool(variables) and self.units.get(variables[0], "") in _ABOVE_ZERO
        return about is not None and not warm and _positive(about)

    def _pooled(self, name: str) -> FloatArray:
        """The values of a signal in all experiments."""
        if name not in self._known:
            self._known[name] = pooled(self.trajectories, name)
        return self._known[name]

    @cached_property
    def _known(self) -> dict[str, FloatArray]:
        return {}

    def _begins(self, name: str) -> bool:
        """Return whether a signal is not zero at the start of some experiment."""
        starts = [each.signal(name)[0] for each in self.trajectories if each.has(name)]
        reach = 1e-6 * float(np.abs(self._pooled(name)).max())
        return bool(np.abs(starts).max() > reach)

    def _reverses(self, name: str) -> bool:
        """Return whether a signal clearly rises and falls in some experiment."""
        signals = [each.signal(name) for each in self.trajectories if each.has(name)]
        least = TURNS * float(np.ptp(self._pooled(name)))
        return any(
            (s - np.minimum.accumulate(s)).max() > least
            and (np.maximum.accumulate(s) - s).max() > least
            for s in signals
        )

    def _about(self, site: EffectSite, variables: tuple[str, ...]) -> FloatArray | None:
        """The signal that a form changes: its variable, or without one the signal at the site."""
        return self._pooled(variables[0]) if variables else self._signal(site)

    def _signal(self, site: EffectSite) -> FloatArray | None:
        if site.kind in ("input", "output"):
            return self._pooled(site.target)
        return None

    @cached_property
    def resolution(self) -> float:
        """The resolution in time: the interval between measurements, or the communication step.

        The larger one is used. Grids of time constants and delays are multiples of the resolution.
        """
        return max(self._step, self.communication)

    @cached_property
    def _step(self) -> float:
        """The median interval between measurements; the times of the grid may be closer."""
        measured = [c.times[np.unique(c.rows)] for c in self.trajectories]
        steps = np.concatenate([np.diff(times) for times in measured])
        if not steps.size:
            steps = np.concatenate([np.diff(c.times) for c in self.trajectories])
        return float(np.median(steps))

    def _coupling(self, site: EffectSite) -> float:
        """Ratio of the actions of two states on each other, such as the ratio of two inertias."""
        largest = np.zeros(2)
        for linear in (each.linear for each in self.trajectories if each.linear is not None):
            first, second = (linear.state_names.index(name) for name in site.targets)
            rates = np.abs(linear.A.row(first)[:, second]), np.abs(linear.A.row(second)[:, first])
            largest = np.maximum(largest, [rate.max() for rate in rates])
        return float(largest[1] / largest[0]) if (largest > 0.0).all() else 1.0

    def _fastest(self, name: str) -> float:
        """Largest rate of change of a signal; at most its range over one sampling interval."""
        pairs = [(trajectory.signal(name), trajectory.times) for trajectory in self.trajectories]
        largest = max(float(np.abs(np.diff(s) / np.diff(t)).max(initial=0.0)) for s, t in pairs)
        return min(largest, float(np.ptp(self._pooled(name))) / self._step)

    def _crossed(self, name: str) -> float:
        """Median change of a signal per step; a solver steps across a narrower switch unnoticed."""
        pairs = [(each.signal(name), each.times) for each in self.trajectories if each.has(name)]
        moved = [np.abs(np.diff(s)) * np.minimum(self.step / np.diff(t), 1.0) for s, t in pairs]
        return float(np.median(np.concatenate(moved)))

    def _travel(self, name: str) -> float:
        """Root mean square of the integral of a signal, about the mean of the integral."""
        ways = self._ways(name)
        total = sum(float(((way - way.mean()) ** 2).sum()) for way in ways)
        return float(np.sqrt(total / max(sum(map(len, ways)), 1)))

    def _ways(self, name: str) -> list[FloatArray]:
        """Integral of a signal from the start of each experiment."""
        return [cumulative_trapezoid(each.signal(name), each.times) for each in self.trajectories]


def _moves(signal: FloatArray) -> bool:
    return bool(np.std(signal) > 1e-9 * np.abs(signal).max())


def _waves(repeats: FloatArray, span: float) -> FloatArray:
    """Wave numbers with these numbers of periods in a span, and 1, 2, 3 ... if they are larger."""
    if not span > 0.0:
        return np.zeros(0)
    waves = 2.0 * np.pi * repeats / span
    whole = np.arange(1.0, len(repeats) // 2 + 1.0)
    return np.concatenate([waves, whole[whole > waves.max()]])


def _positive(signal: FloatArray) -> bool:
    """Return whether a signal is never negative, within the error of a solver."""
    return bool(signal.min() >= -1e-6 * np.abs(signal).max())


def oscillates(signal: FloatArray) -> bool:
    """Return whether a signal is clearly positive at times and clearly negative at others."""
    reach = BOTH_SIGNS * float(np.sqrt(np.mean(signal**2)))
    return bool(signal.min() < -reach and signal.max() > reach)


_ABOVE_ZERO = {"K": 0.0, "degC": 273.15, "Cel": 273.15, "\N{DEGREE SIGN}C": 273.15}
"""How far the zero of a temperature unit lies above absolute zero."""
_OF_SIGNAL = (GridScale.MAX_S, GridScale.RANGE_S, GridScale.FASTEST_S)
_OF_SECOND = (GridScale.LOW_W, GridScale.HIGH_W, GridScale.MAX_W)
_ENDS = (GridScale.LOW_V, GridScale.HIGH_V, GridScale.LOW_W, GridScale.HIGH_W)
_AS_THEY_ARE = (
    GridScale.EXPONENT, GridScale.NUMBER, GridScale.DAMPING, GridScale.SHARE, GridScale.KELVIN,
)  # fmt: skip
"""Scales whose grid entries are the values themselves, independent of the data."""
_SIZES: Mapping[GridScale, Callable[[FloatArray], Any]] = {
    GridScale.MEAN_V: lambda v: v.mean(),
    GridScale.MEAN_ABSOLUTE_V: lambda v: np.abs(v).mean(),
    GridScale.MEAN_SQUARE_V: lambda v: (v**2).mean(),
    GridScale.LOW_V: lambda v: np.quantile(v, 0.01),
    GridScale.HIGH_V: lambda v: np.quantile(v, 0.99),
    GridScale.LOW_W: lambda w: np.quantile(w, 0.01),
    GridScale.HIGH_W: lambda w: np.quantile(w, 0.99),
    GridScale.MAX_V: lambda v: np.abs(v).max(),
    GridScale.MAX_W: lambda w: np.abs(w).max(),
    GridScale.MAX_S: lambda s: np.abs(s).max(),
    GridScale.RMS_V: lambda v: np.sqrt(np.mean(v**2)),
}
"""Sizes of a signal; the entries of a grid are multiples of them."""
