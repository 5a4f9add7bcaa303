"""Sentences on the expected information of an experiment."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cluster_est.problem.display import in_a_row, percent
from cluster_est.toml import inline
from workers.messages import Experiment, Input

TOLD_APART = 2.0
"""Expected difference of log likelihoods required for discrimination: a factor of 7."""


@dataclass(frozen=True)
class ExpectedEvidence:
    """The expected evidence of an experiment for a model against a rival.

    Attributes
    ----------
    true_model, rival
        The evidence applies if the first is true.
    evidence
        Expected difference of their log likelihoods.
    random, recorded
        Expected difference for a random input within the same limits (the median of the tested
        ones) and for the best recorded input; NaN without any.
    best
        The largest expected difference of any tested input.
    """

    true_model: str
    rival: str
    evidence: float
    random: float
    recorded: float
    best: float


@dataclass(frozen=True)
class ExpectedProbability:
    """The expected probability of a model after an experiment, if it is true.

    Attributes
    ----------
    model
        Name of the model.
    before, after
        Probability now, and after the experiment.
    random, recorded
        With a random input or a recorded input, see `ExpectedEvidence`.
    """

    model: str
    before: float
    after: float
    random: float
    recorded: float


@dataclass(frozen=True)
class ExpectedPredictionError:
    """The expected influence of an experiment on a prediction.

    Attributes
    ----------
    experiment, output, unit
        The predicted output.
    std_error_before, std_error_after
        Its standard deviation due to the parameters now, and after the experiment: root mean square
        over the samples, without measurement noise.
    random, recorded
        The standard deviation with a random input or a recorded input, see `ExpectedEvidence`.
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
    """The expected influence of an experiment on a parameter.

    Attributes
    ----------
    label, unit, value
        The parameter, and its estimate.
    std_error_before, std_error_after
        Its standard error now, and after the experiment.
    random, recorded
        Standard errors with a random input or a recorded input, see `ExpectedEvidence`.
    """

    label: str
    unit: str
    value: float
    std_error_before: float
    std_error_after: float
    random: float
    recorded: float


WORTH_SAYING = 0.1
"""Smallest increase of a probability that is mentioned."""
NO_CHANGE = 0.995
"""Ratio of the new to the old standard error above which it counts as unchanged."""
LARGEST_LIKELIHOOD_RATIO = 1e6
"""Likelihood ratio above which no number is given."""


def times(evidence: float) -> str:
    """Return the factor by which evidence makes a rival less likely, such as "40 times"."""
    if math.isnan(evidence):
        return "unknown"
    if evidence > math.log(LARGEST_LIKELIHOOD_RATIO):
        return "more than a million times"
    factor = math.exp(max(evidence, 0.0))
    if factor < 10.0:
        return f"{factor:.1f} times"
    return f"{float(f'{factor:.2g}'):,.0f} times"


def evidence_sentence(
    evidence: Sequence[ExpectedEvidence],
    probabilities: Sequence[ExpectedProbability],
    looked_at: int,
) -> str:
    """Return how clearly the experiment should distinguish the first model from its rival."""
    first = evidence[0].true_model
    own = [row for row in evidence if row.true_model == first and row.evidence >= TOLD_APART]
    if not own:
        return (
            f"if {first} is right, the best of the {looked_at} inputs that were tried does not "
            f"distinguish it from its rivals{_of_others(probabilities)}"
        )
    nearest = min(own, key=lambda row: row.evidence)
    said = (
        f"if {first} is right, this experiment is expected to make {nearest.rival}, the rival that "
        f"is hardest to distinguish, {times(nearest.evidence)} less likely"
    )
    others = []
    if not math.isnan(nearest.random):
        others.append(f"{times(nearest.random)} with a random input within the same limits")
    if not math.isnan(nearest.recorded):
        others.append(f"{times(nearest.recorded)} with a repetition of the best recorded input")
    return f"{said} ({', '.join(others)})" if others else said


def _of_others(probabilities: Sequence[ExpectedProbability]) -> str:
    """Return which other model the experiment would make likely, if it is true."""
    most = max(probabilities[1:], key=lambda row: row.after - row.before)
    if most.after - most.before < WORTH_SAYING:
        return ""
    return (
        f"; if {most.model} is right, its probability is expected to rise from "
        f"{percent(most.before)} to {percent(most.after)}"
    )


def alike_sentences(evidence: Sequence[ExpectedEvidence], looked_at: int) -> list[str]:
    """Return the rivals that the best input does not distinguish from the first model."""
    first = evidence[0].true_model
    alike = [r.rival for r in evidence if r.true_model == first and r.evidence < TOLD_APART]
    if not alike:
        return []
    return [
        f"if {first} is right, the best of the {looked_at} inputs that were tried does not "
        f"distinguish it from {in_a_row(alike)}: the models predict nearly the same, or one "
        "contains the other as a special case; wider limits or more candidates may help"
    ]


def narrowed_sentence(rows: Sequence[ExpectedPrecision]) -> str:
    """Return the expected change of the standard errors."""

    def share(name: str) -> float:
        ratios = [
            getattr(row, name) / row.std_error_before for row in rows if row.std_error_before > 0.0
        ]
        known = [each for each in ratios if not math.isnan(each)]
        if not known:
            return math.nan
        return math.exp(sum(math.log(max(each, 1e-300)) for each in known) / len(known))

    if not share("std_error_after") < NO_CHANGE:
        return "the experiment is expected to give almost no information about the parameters"
    said = (
        f"the standard errors are expected to fall to {share('std_error_after'):.2g} times their "
        "present values (geometric mean)"
    )
    return "; ".join([said, *_beside(share)])


def _beside(share: Callable[[str], float]) -> list[str]:
    """Return the expected changes with a random input and with a recorded one."""
    inputs = {
        "random": "with a random input within the same limits",
        "recorded": "with a repetition of a recorded input",
    }
    return [
        f"{which}, to {share(name):.2g}"
        for name, which in inputs.items()
        if not math.isnan(share(name))
    ]


def predicted_sentence(rows: Sequence[ExpectedPredictionError]) -> str:
    """Return the expected change of predictions."""

    def share(name: str) -> float:
        squares = [(getattr(row, name) / row.std_error_before) ** 2 for row in rows]
        return math.sqrt(sum(squares) / len(squares))

    if not share("std_error_after") < NO_CHANGE:
        return "the experiment is expected to give almost no information about the predictions"
    first = f"{rows[0].output} in {rows[0].experiment}"
    more = f" and {len(rows) - 1} other prediction{'s' if len(rows) > 2 else ''}"
    several = len(rows) > 1
    said = (
        f"the standard deviation{'s' if several else ''} of {first}{more if several else ''} "
        f"{'are' if several else 'is'} expected to fall to {share('std_error_after'):.2g} times "
        f"{'their present values (root mean square)' if several else 'its present value'}"
    )
    return "; ".join([said, *_beside(share)])


TABLE, STEM = "TABLE.csv", "TABLE"
"""Placeholders in run.json for the table and its name, which the run does not know."""


def experiment_block(experiment: Experiment, data: str, name: str) -> str:
    """Return the lines of the entry.

    Parameters
    ----------
    experiment
        The experiment with its inputs, and outputs to measure.
    data, name
        Path of its table relative to the config's folder, and the name of the experiment.
    """
    inputs = {given.variable: _column(given) for given in experiment.inputs}
    signals = {given.variable: _column(given) for given in experiment.signals}
    lines = [
        "[[experiments]]",
        f"id = {inline(name)}",
        f"data = {inline(data)}",
        'time = "time"',
        f"inputs = {inline(inputs)}",
        f"outputs = {inline({o.variable: o.variable for o in experiment.outputs})}",
        *([f"signals = {inline(signals)}"] if signals else []),
        *([f"values = {inline(dict(experiment.values))}"] if experiment.values else []),
        *([f"group = {inline(dict(experiment.groups))}"] if experiment.groups else []),
    ]
    return "\n".join(lines) + "\n"


def block_for_table(block: str, table: Path, base: str | None) -> str:
    """Return the entry of a design for its table.

    Parameters
    ----------
    block
        The entry, as run.json has it.
    table
        The table of the next experiment.
    base
        Folder to which the paths in the config are relative, if known.
    """
    path = os.path.relpath(table, base) if base else str(table)
    return block.replace(TABLE, Path(path).as_posix()).replace(STEM, table.stem)


def _column(given: Input) -> str | dict[str, str]:
    """Return the column of an input in the notation of a config."""
    if given.interpolation == "linear":
        return given.variable
    return {"column": given.variable, "interpolation": given.interpolation}
