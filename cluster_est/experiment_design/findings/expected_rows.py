"""Rows of the tables that say what an experiment is expected to tell."""

from __future__ import annotations

from dataclasses import dataclass

TOLD_APART = 2.0
"""Expected difference of log likelihoods below which nothing is told apart: a factor of 7."""


@dataclass(frozen=True)
class ExpectedEvidence:
    """What an experiment is expected to say for a model against a rival.

    Attributes
    ----------
    true_model, rival
        If the first is the true one.
    evidence
        Expected difference of their log likelihoods.
    random, recorded
        The same for a random input within the same limits (the median of those that were looked
        at) and for the best one of those that were recorded; NaN without any.
    best
        The largest that any input that was looked at is expected to give.
    """

    true_model: str
    rival: str
    evidence: float
    random: float
    recorded: float
    best: float


@dataclass(frozen=True)
class ExpectedProbability:
    """The probability that a model is expected to have after an experiment, if it is true.

    Attributes
    ----------
    model
        Which.
    before, after
        So far, and with the experiment.
    random, recorded
        With a random input or a recorded one, see `ExpectedEvidence`.
    """

    model: str
    before: float
    after: float
    random: float
    recorded: float


@dataclass(frozen=True)
class ExpectedPredictionError:
    """What an experiment is expected to do to a prediction.

    Attributes
    ----------
    experiment, output, unit
        What is predicted.
    std_error_before, std_error_after
        The standard deviation that the parameters give it so far, and with the experiment: root
        mean square over the samples, without the noise of a measurement.
    random, recorded
        The same with a random input or a recorded one, see `ExpectedEvidence`.
    """

    experiment: str
    output: str
    unit: str
    std_error_before: float
    std_error_after: float
    random: float
    recorded: float


@dataclass(frozen=True)
class ExpectedPrecision:
    """What an experiment is expected to do to a parameter.

    Attributes
    ----------
    label, unit, value
        The parameter, and its estimate.
    std_error_before, std_error_after
        Its standard error so far, and with the experiment.
    random, recorded
        Standard errors with a random input or a recorded one, see `ExpectedEvidence`.
    """

    label: str
    unit: str
    value: float
    std_error_before: float
    std_error_after: float
    random: float
    recorded: float
