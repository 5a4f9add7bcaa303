"""Thresholds that an effect must pass, and those of the verdict."""

from __future__ import annotations

from dataclasses import dataclass

from cluster_est.statistics.residual_tests import FAMILY_WISE_LEVEL


@dataclass(frozen=True)
class SelectionThresholds:
    """Thresholds that the best contender of a round must pass.

    Attributes
    ----------
    choice_price
        Logarithms of the number of candidates that the gain must pay for. Theory: a Bonferroni
        correction, twice the logarithm on the scale of the criterion.
    pair_price
        The same, of two effects in the place of one. Theory: the pairs are as many as the square.
    solo_gain
        Gain of the criterion with which an effect may live in a minority of the experiments.
        Benchmark.
    solo_share
        Ratio of squares below which an experiment fits clearly better. Benchmark.
    minority
        Share of the experiments that is one. By definition.
    hard
        Share of the gap to the noise that a single effect must close, or two at once are tried.
        Benchmark.
    gap
        Residual over noise, in squares, above which an effect must close a part of it. Benchmark.
    least_gap
        Share of the noise that a gap counts as at least. Benchmark.
    mostly_better
        Share of the parts left out that must be predicted better for the rest to count as noise.
        Benchmark.
    least_fall
        Share of the squares that must be explained for the same. Benchmark.
    local_minimum
        Ratio of squares below which the declared model, restarted from the new parameters, was in a
        local minimum before. Benchmark.
    autoregression
        Order of the noise that a gain is compared with. Signal: the noise of a sensor with that of
        a process on it is no autoregression of low order; the order up to which intervals look.
    """

    choice_price: float = 2.0
    pair_price: float = 4.0
    solo_gain: float = 30.0
    solo_share: float = 0.98
    minority: float = 0.5
    hard: float = 0.7
    gap: float = 1.15
    least_gap: float = 0.02
    mostly_better: float = 0.75
    least_fall: float = 0.02
    local_minimum: float = 0.97
    autoregression: int = 20


@dataclass(frozen=True)
class WaveThresholds:
    """Thresholds that a wave in time must pass beside all others.

    Attributes
    ----------
    periods
        That the longest record must have of a wave. Signal: of fewer a drift looks the same.
    nearly
        Share of what it explains that a mechanism must explain to come first. Benchmark.
    apart
        Of its strength, by which the experiments may want another function of time on average.
        Theory: with phases or signs at random what all share is smaller than what each wants.
    """

    periods: float = 3.0
    nearly: float = 0.95
    apart: float = 0.5


@dataclass(frozen=True)
class AcceptanceThresholds:
    """Thresholds of the leave-one-out prediction and of the check for stability.

    Attributes
    ----------
    step_lengths
        Parts of the Gauss-Newton step to the fit without a part. Benchmark.
    largest_step
        Of a parameter: in logarithms, or as a share of its value. Benchmark.
    few
        Up to so many experiments, parts of their records are left out instead: without one there
        would be one left, or none. By definition.
    parts
        Of a record that is left out in parts. Benchmark.
    unpredicted
        Factor on its own squares where no prediction can be simulated. Benchmark.
    reach
        Times its measured half range that an output may reach with enlarged inputs. Benchmark.
    """

    step_lengths: tuple[float, ...] = (1.0, 0.4)
    largest_step: float = 0.5
    few: int = 2
    parts: int = 4
    unpredicted: float = 4.0
    reach: float = 6.0


@dataclass(frozen=True)
class VerdictThresholds:
    """Thresholds of the verdict.

    Attributes
    ----------
    structure
        p-value of the test for smooth structure up to which structure counts as left, as for a
        fit. Theory: its size.
    excess
        Residual over noise, in squares, less 1, below which nothing can be left. Benchmark.
    coloured
        Residual over the estimated noise above which what is left is no noise of a sensor, where
        no sigma is declared. Theory: a fourth difference of first-order noise with a correlation
        of 0.93 is five times too small.
    partial
        Partial autocorrelation beyond lag 1 up to which noise counts as of first order. Benchmark.
    nearly_all
        Share of the gap to the noise, in squares, that effects must close for "found". Benchmark.
    most
        The same for "partial": the error is at least halved, on training and on held-out data.
        By definition: what explains less is a hint, and no model.
    most_by_curve
        The same for "partial" with a free curve, which takes any shape: what it leaves says that
        the effect is another one. Benchmark.
    mostly_better
        Share of the parts left out that must be predicted better for the rest to count as noise.
        Benchmark.
    """

    structure: float = FAMILY_WISE_LEVEL
    excess: float = 0.05
    coloured: float = 5.0
    partial: float = 0.1
    nearly_all: float = 0.98
    most: float = 0.75
    most_by_curve: float = 0.9
    mostly_better: float = 0.75
