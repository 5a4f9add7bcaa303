"""Thresholds of the candidates and of the tests that rank them."""

from __future__ import annotations

from dataclasses import dataclass

from cluster_est.statistics.score import CONFOUNDED


@dataclass(frozen=True)
class CandidateThresholds:
    """Thresholds of the list of candidates and their grids.

    Attributes
    ----------
    both_signs
        Share of its rms that a signal must reach on both sides of zero to oscillate. Benchmark.
    narrowest, widest
        Factors by which a refit may go beyond the grid of a positive coefficient. Benchmark.
    shortest
        Share of the interval between measurements, or of a longer communication step, that a time
        constant has at least, be it a lag's or that of a state which stops itself. Signal: what is
        shorter is a gain of a slope to the data, or a hard stop, and costs a solver steps in
        proportion (at a twentieth, 40 times the simulation of two tanks).
    kinematic
        Relative gap of der(x) and another state below which they are the same: a little above the
        error of a solver. Signal.
    """

    both_signs: float = 0.15
    narrowest: float = 20.0
    widest: float = 50.0
    shortest: float = 0.1
    kinematic: float = 1e-6


@dataclass(frozen=True)
class ScreeningThresholds:
    """Thresholds of the score tests of all candidates.

    Attributes
    ----------
    most_rows
        Residuals that are screened; longer records are thinned. Memory: all directions of some
        hundred candidates at once.
    most_values
        The same times the columns of all candidates. Memory: 128 MB, and some five copies of it.
    peaks
        Frequencies of the residual's spectrum that periodic effects begin with. Benchmark.
    peak_samples
        Samples that a record needs for a spectrum. Signal.
    peak_distance
        Relative distance of two peaks that count as different. Benchmark.
    column_penalty
        Rise of the statistic that each further column of a candidate must bring to be ranked as
        high. Benchmark; its mean is 1 where the column means nothing (theory: chi-squared).
    curves
        Places of leading free curves at which finer ones are looked at. Benchmark.
    probed_curves
        The same in co-simulation, where each value of a curve takes simulations of its own.
        Benchmark.
    confounded
        Share of a direction outside the declared parameters below which it cannot be told from
        them. Signal: the linearisations of a simulation are not more exact.
    autoregression
        Order of the autoregression that whitens. Benchmark.
    probe_amount
        Share of the signal that it changes by which a candidate is switched on in co-simulation.
        Signal: large beside a solver's error, small beside the signal.
    """

    most_rows: int = 20_000
    most_values: int = 16_000_000
    peaks: int = 2
    peak_samples: int = 16
    peak_distance: float = 0.1
    column_penalty: float = 8.0
    curves: int = 12
    probed_curves: int = 4
    confounded: float = CONFOUNDED
    autoregression: int = 2
    probe_amount: float = 0.01


@dataclass(frozen=True)
class PlaceThresholds:
    """Thresholds of the ranking of places, where there are too many candidates to look at each.

    Attributes
    ----------
    most_candidates
        Candidates above which only those at leading places are looked at. Memory: see `most_rows`.
    leading
        Places that are looked at. Benchmark.
    hats
        Coefficients of the curve that stands for every form. Benchmark.
    weightings
        Random weightings that estimate the size of a direction. Theory: the relative error of a
        squared length is the square root of 2 over their number.
    price
        Rise of the statistic that each further coefficient must bring; see `column_penalty`.
        Benchmark.
    """

    most_candidates: int = 1500
    leading: int = 40
    hats: int = 9
    weightings: int = 96
    price: float = 8.0
