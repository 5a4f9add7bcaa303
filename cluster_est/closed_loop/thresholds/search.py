"""Thresholds of the refits of candidates, and of the structures that are grown from them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RefinementThresholds:
    """Thresholds of the simulations and refits of leading candidates.

    Attributes
    ----------
    step_lengths
        Parts of the linear model's step that are tried. Benchmark.
    largest_step
        Of a parameter: in logarithms, or as a share of its value. Benchmark.
    weakest, strongest
        Factors between which a finite amount of the grid is scaled. Benchmark.
    points_of_grid
        Points of a candidate's grid that are tried, the best by score. Benchmark.
    white_leaders
        Leaders of the whitened scores that are tried besides. Benchmark.
    closes
        Share of the gap to the noise that a single effect must close, or more are tried.
        Benchmark.
    actual_reduction
        Share of the predicted reduction that a step must bring, or a shorter one is
        tried. Theory: half of it is a good step, J. J. More, doi:10.1007/BFb0067700.
    behind
        Share of what the best candidate does, where that closes the gap, that another must do to
        be refitted further. Benchmark.
    claim_promise, rival_promise
        Times the fall of the squares that the linear model promises for an effect that is not yet
        there, that it may bring: where a claim hangs on it, and where it must come near what was
        found already. Benchmark: 1.1 times as a median, 1.5 times in one of twenty.
    linear_promise
        Times the fall of the criterion that the linear model promises after some iterations that
        the rest of a fit may bring. Benchmark.
    finalists
        Candidates that are refitted to convergence. Benchmark.
    promising
        Candidates that go on although they are behind, because of what the linear model promises.
        Benchmark.
    curves
        Free curves that are refitted. Benchmark.
    same_argument
        Other functions of the best candidate's argument that are refitted. Benchmark.
    explains
        Share of what that candidate does that they must be able to do. Benchmark.
    settled
        Fall of the criterion that ends a refit to convergence. Theory: a tenth of `equal`.
    equal
        Difference of criteria that does not tell two candidates apart. Theory: below 2 "not worth
        more than a bare mention", R. E. Kass, A. E. Raftery, J. Am. Stat. Assoc. 90 (1995) 773-795.
    alternative
        Difference of criteria that leaves a candidate possible. Theory: above 10 the evidence is
        "very strong", ibid.
    """

    step_lengths: tuple[float, ...] = (1.0, 0.3)
    largest_step: float = 0.8
    weakest: float = 0.06
    strongest: float = 3.0
    points_of_grid: int = 2
    white_leaders: int = 8
    closes: float = 0.9
    actual_reduction: float = 0.5
    behind: float = 0.25
    claim_promise: float = 2.0
    rival_promise: float = 1.5
    linear_promise: float = 3.0
    finalists: int = 3
    promising: int = 2
    curves: int = 2
    same_argument: int = 3
    explains: float = 0.8
    settled: float = 0.2
    equal: float = 2.0
    alternative: float = 10.0


@dataclass(frozen=True)
class PairThresholds:
    """Thresholds of the search for two effects at once.

    Attributes
    ----------
    leaders
        Directions that are paired. Benchmark; the work grows with its square.
    alike
        Cosine above which two directions are no pair. Benchmark.
    fitted
        Pairs that are refitted. Benchmark.
    """

    leaders: int = 90
    alike: float = 0.98
    fitted: int = 8


@dataclass(frozen=True)
class BeamThresholds:
    """Thresholds of the beam: the structures that each round grows.

    Attributes
    ----------
    alike
        Cosine between the changes of two structures' predictions above which they count as one.
        Benchmark.
    """

    alike: float = 0.98


@dataclass(frozen=True)
class RevisionThresholds:
    """Thresholds of the revision of effects that were added before.

    Attributes
    ----------
    sweeps
        Rounds through all effects at most. Benchmark.
    swap
        Fall of the criterion for which an earlier effect is replaced. Benchmark.
    drop_price
        Logarithms of the number of candidates by which the criterion may rise where an effect is
        dropped. Theory: a Bonferroni correction, twice the logarithm on the scale of the criterion.
    """

    sweeps: int = 2
    swap: float = 4.0
    drop_price: float = 2.0
