"""What the data say about where the coefficients of a form could lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.course import Course, pooled
from workers.effects.forms import Coefficient, Form
from workers.effects.site import Site
from workers.messages import FloatArray

BOTH_SIGNS = 0.15
"""Share of its rms that a signal must reach on both sides of zero to count as oscillating."""


@dataclass(frozen=True)
class Scales:
    """Sizes of all signals over all training experiments."""

    courses: Sequence[Course]
    frequencies: Sequence[float]

    def allow(self, form: Form, site: Site, variables: tuple[str, ...]) -> bool:
        """Whether a form makes sense for these signals."""
        about = self._about(site, variables)
        if about is not None and float(np.std(about)) <= 1e-9 * float(np.abs(about).max() + 1e-300):
            return False
        words = form.when.split()
        if "oscillates" in words and not (about is not None and oscillates(about)):
            return False
        if "positive" in words and not (about is not None and float(about.min()) >= -1e-6):
            return False
        return not ("both" in words and about is None)

    def grid(
        self, coefficient: Coefficient, site: Site, variables: tuple[str, ...]
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

    def _about(self, site: Site, variables: tuple[str, ...]) -> FloatArray | None:
        """The signal that a form bends: its variable, else what passes the site."""
        return pooled(self.courses, variables[0]) if variables else self._signal(site)

    def _signal(self, site: Site) -> FloatArray | None:
        if site.kind in ("input", "output"):
            return pooled(self.courses, site.target)
        return None

    def _step(self) -> float:
        return float(np.median(np.concatenate([np.diff(c.times) for c in self.courses])))

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


def oscillates(signal: FloatArray) -> bool:
    """Whether a signal takes both signs clearly."""
    reach = BOTH_SIGNS * float(np.sqrt(np.mean(signal**2)))
    return bool(signal.min() < -reach and signal.max() > reach)
