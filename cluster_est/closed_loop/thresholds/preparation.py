"""Thresholds on the data, the declared model and its numerical error, before a search begins."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PreparationThresholds:
    """Thresholds on the data before the loop begins, and the synthetic experiments made of them.

    Attributes
    ----------
    samples_per_unknown
        Measured values for each unknown that a loop needs. Benchmark.
    horizons
        Shares of each record that a start grows through. Benchmark.
    shortest
        Samples of each output that a shortened experiment keeps at least. Benchmark.
    enlargement
        Factor by which inputs swing further in the check for stability. Benchmark.
    outliers
        Share of an output's samples that are set aside as outliers at most. Signal: a sensor that
        is wrong more often than once in 20 samples is no sensor.
    exact
        Share of an output's range that its noise counts as at least where outliers are looked for.
        Signal: a simulation is hardly more exact, and what it gets wrong is no sensor's fault.
    growth
        Noise where a signal is large over that where it is small, from which a note is made.
        Theory: with weights wrong by a factor of 2 in sigma, least squares loses a third of its
        efficiency; with less, little.
    growth_p
        Largest p-value for the same. Theory: a thousand outputs have a false note with 0.001.
    """

    samples_per_unknown: int = 4
    horizons: tuple[float, ...] = (0.15, 0.4)
    shortest: int = 12
    enlargement: float = 1.25
    outliers: float = 0.05
    exact: float = 1e-5
    growth: float = 2.0
    growth_p: float = 1e-6


@dataclass(frozen=True)
class DeclaredModelThresholds:
    """Thresholds of the fit of the declared model.

    Attributes
    ----------
    at_noise
        Residual over noise below which no other start is tried. Benchmark.
    spread
        Of the starts around the user's: in logarithms, or as a share of a value. Benchmark.
    survivors
        Starts that go on after each horizon. Benchmark.
    distinct
        Relative distance of two fits that count as different. Benchmark.
    """

    at_noise: float = 1.05
    spread: float = 0.35
    survivors: tuple[int, ...] = (4, 2)
    distinct: float = 1e-2


@dataclass(frozen=True)
class NumericalErrorThresholds:
    """Thresholds of the error of solver and steps, beside the noise.

    Attributes
    ----------
    small
        Error over noise up to which it is not spoken of. Theory: among some 2,500 samples its sum
        of squares is then 6 times the noise's variance, less than the choice among the candidates
        costs an effect, see `SelectionThresholds.choice_price`.
    large
        The same, above which no effect is looked for. Theory: a quarter of the noise's variance, in
        a shape that is the same in every experiment, is what an effect looks like.
    share
        Error over residual up to which a large one does not end the search, because most of the
        residual is something else. By definition: a hundredth of its squares.
    known
        Factor by which the error may be larger than measured. Theory: that between an error of
        first order and the change where its step is halved.
    loose
        Relative tolerance above which the error is spoken of in any case. By definition.
    """

    small: float = 0.05
    large: float = 0.5
    share: float = 0.1
    known: float = 2.0
    loose: float = 1e-4
