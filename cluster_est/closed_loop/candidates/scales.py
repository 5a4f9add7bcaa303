"""What the data say about where the coefficients of a form could lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from workers.effects.forms import EffectForm, FormCoefficient
from workers.effects.site import EffectSite
from workers.messages import FloatArray

BOTH_SIGNS = 0.15
"""Share of its rms that a signal must reach on both sides of zero to count as oscillating."""


@dataclass(frozen=True)
class SignalScales:
    """Sizes of all signals over all training experiments."""

    courses: Sequence[LinearisedTrajectory]
    frequencies: Sequence[float]

    def allow(self, form: EffectForm, site: EffectSite, variables: tuple[str, ...]) -> bool:
        """Whether a form makes sense for these signals."""
        about = self._about(site, variables)
        signals = [pooled(self.courses, name) for name in variables]
        if about is not None and not all(_moves(signal) for signal in (about, *signals)):
            return False
        words = form.when.split()
        if "oscillates" in words and not (about is not None and oscillates(about)):
            return False
        if "positive" in words and not (about is not None and _positive(about)):
            return False
        spread = [c.scale for c in form.coefficients if c.scale in ("low v", "high v")]
        ends = {self.grid(FormCoefficient("", scale=scale), site, variables) for scale in spread}
        return len(ends) == len(spread)

    def grid(
        self, coefficient: FormCoefficient, site: EffectSite, variables: tuple[str, ...]
    ) -> tuple[float, ...]:
        """Values of a coefficient to look at."""
        if coefficient.scale == "spectrum":
            return tuple(self.frequencies)
        kind, _, name = coefficient.scale.partition(" ")
        grid = coefficient.grid or (1.0,)
        if kind == "step":
            return tuple(g * self._step() for g in grid)
        if kind == "middle":
            return tuple(g * self._middle() for g in grid)
        signal = self._signal(site) if name == "s" else self._about(site, variables)
        if signal is None:
            return ()
        return tuple(float(x) for x in self._sized(kind, name, signal, grid, variables))

    def _sized(
        self,
        kind: str,
        name: str,
        signal: FloatArray,
        grid: Sequence[float],
        variables: tuple[str, ...],
    ) -> list[float]:
        rates = np.array(grid)
        if kind == "quantile":
            return list(np.quantile(signal, rates))
        if kind == "range":
            return list(signal.min() + rates * (signal.max() - signal.min()))
        if kind == "mean":
            value = {"v": signal, "|v|": np.abs(signal), "v^2": signal**2}[name].mean()
        elif kind == "travel":
            value = self._travel(variables[0])
        elif kind == "low":
            value = np.quantile(signal, 0.01)
        elif kind == "high":
            value = np.quantile(signal, 0.99)
        else:
            value = np.abs(signal).max() if kind == "max" else np.sqrt(np.mean(signal**2))
        return list(rates * value)

    def _about(self, site: EffectSite, variables: tuple[str, ...]) -> FloatArray | None:
        """The signal that a form bends: its variable, else what passes the site."""
        return pooled(self.courses, variables[0]) if variables else self._signal(site)

    def _signal(self, site: EffectSite) -> FloatArray | None:
        if site.kind in ("input", "output"):
            return pooled(self.courses, site.target)
        return None

    def _step(self) -> float:
        """The usual interval between measurements; the grid has other times too."""
        measured = [c.times[np.unique(c.rows)] for c in self.courses]
        steps = np.concatenate([np.diff(times) for times in measured])
        if not steps.size:
            steps = np.concatenate([np.diff(c.times) for c in self.courses])
        return float(np.median(steps))

    def _middle(self) -> float:
        return float(np.mean([0.5 * (c.times[0] + c.times[-1]) for c in self.courses]))

    def _travel(self, name: str) -> float:
        """Root mean square of the integral of a signal about its mean."""
        total, count = 0.0, 0
        for course in self.courses:
            signal = course.signal(name)
            steps = 0.5 * (signal[1:] + signal[:-1]) * np.diff(course.times)
            way = np.cumsum(steps)
            total += float(((way - way.mean()) ** 2).sum())
            count += len(way)
        return float(np.sqrt(total / max(count, 1)))


def _moves(signal: FloatArray) -> bool:
    return bool(np.std(signal) > 1e-9 * np.abs(signal).max())


def _positive(signal: FloatArray) -> bool:
    """Whether a signal is never negative, but for the error of a solver."""
    return bool(signal.min() >= -1e-6 * np.abs(signal).max())


def oscillates(signal: FloatArray) -> bool:
    """Whether a signal takes both signs clearly."""
    reach = BOTH_SIGNS * float(np.sqrt(np.mean(signal**2)))
    return bool(signal.min() < -reach and signal.max() > reach)
