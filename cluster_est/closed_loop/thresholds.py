"""The statistical and physical choices of a closed loop, grouped by the step that makes them.

Each says where it comes from. "Theory" names a result; "signal" is a property of measured data or
of a simulation; "benchmark" means that no theory gives it, and that the rates of
`scripts/closed_loop_benchmark/RESULTS.md` were measured with it: tune it on the systems there that
say `split="tune"`, never on the others. Guards against rounding stand where they are needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from cluster_est.statistics.omnibus import DRAWS, LENGTHS
from cluster_est.statistics.score import CONFOUNDED


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
        constant has at least. Signal: what is shorter is a gain of a slope to the data, and costs a
        solver steps in proportion (at a twentieth, 40 times the simulation of two tanks).
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
        The same times the columns of all candidates. Memory: 160 MB, and some five copies of it.
    peaks
        Frequencies of the residual's spectrum that periodic effects begin with. Benchmark.
    peak_samples
        Samples that a record needs for a spectrum. Signal.
    peak_distance
        Relative distance of two peaks that count as different. Benchmark.
    column_penalty
        Rise of the statistic that each further column of a candidate must bring to be ranked as
        high. Benchmark; its mean is 1 where the column means nothing (theory: chi-squared).
    confounded
        Share of a direction outside the declared parameters below which it cannot be told from
        them. Signal: the linearisations of a simulation are not more exact.
    autoregression
        Order of the autoregression that whitens. Benchmark.
    omnibus_lengths
        Lengths of smooth structure, in samples, that the omnibus test looks for. Benchmark.
    omnibus_draws
        Of its null distribution: a p-value of 0.01 needs some hundred. Theory: Monte Carlo tests.
    probe_amount
        Share of the signal that it changes by which a candidate is switched on in co-simulation.
        Signal: large beside a solver's error, small beside the signal.
    """

    most_rows: int = 20_000
    most_values: int = 20_000_000
    peaks: int = 2
    peak_samples: int = 16
    peak_distance: float = 0.1
    column_penalty: float = 8.0
    confounded: float = CONFOUNDED
    autoregression: int = 2
    omnibus_lengths: tuple[float, ...] = LENGTHS
    omnibus_draws: int = DRAWS
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
    finalists
        Candidates that are refitted to convergence. Benchmark.
    curves
        Free curves that are refitted. Benchmark.
    same_argument
        Other functions of the best candidate's argument that are refitted. Benchmark.
    explains
        Share of what that candidate does that they must be able to do. Benchmark.
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
    finalists: int = 3
    curves: int = 2
    same_argument: int = 3
    explains: float = 0.8
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
        Of its amplitude, by which the experiments may want another wave on average. Theory: with
        phases at random the wave that all share is smaller than what each wants.
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
        Standardised omnibus statistic above which structure counts as left. Benchmark.
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
    smooth
        p-value of the omnibus test above which a residual is not called autocorrelated. Benchmark.
    """

    structure: float = 5.0
    excess: float = 0.05
    coloured: float = 5.0
    partial: float = 0.1
    nearly_all: float = 0.98
    most: float = 0.75
    most_by_curve: float = 0.9
    mostly_better: float = 0.75
    smooth: float = 0.1


@dataclass(frozen=True)
class LoopThresholds:
    """All thresholds of a closed loop, by step."""

    preparation: PreparationThresholds = field(default_factory=PreparationThresholds)
    declared_model: DeclaredModelThresholds = field(default_factory=DeclaredModelThresholds)
    numerical_error: NumericalErrorThresholds = field(default_factory=NumericalErrorThresholds)
    candidates: CandidateThresholds = field(default_factory=CandidateThresholds)
    screening: ScreeningThresholds = field(default_factory=ScreeningThresholds)
    places: PlaceThresholds = field(default_factory=PlaceThresholds)
    refinement: RefinementThresholds = field(default_factory=RefinementThresholds)
    pairs: PairThresholds = field(default_factory=PairThresholds)
    beam: BeamThresholds = field(default_factory=BeamThresholds)
    revision: RevisionThresholds = field(default_factory=RevisionThresholds)
    selection: SelectionThresholds = field(default_factory=SelectionThresholds)
    waves: WaveThresholds = field(default_factory=WaveThresholds)
    acceptance: AcceptanceThresholds = field(default_factory=AcceptanceThresholds)
    verdict: VerdictThresholds = field(default_factory=VerdictThresholds)
