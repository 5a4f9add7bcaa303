"""What is said of the residuals of a fit, in sentences and as facts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

from cluster_est.statistics.residual_findings import (
    OutputDiagnostics,
    ResidualDiagnostics,
    ResidualStructure,
    SigmaDoubt,
)

MOST_OUTPUTS = 4
"""Outputs in a sentence; of more, those with the largest error are named."""

VISIBLE = 0.1
"""Correlation of neighbours below which it is better said over how many samples they are alike."""

ADVICE = "to look for it: cluster-est close-loop CONFIG --out FOLDER, in Python close_loop(problem)"


def residual_facts(diagnostics: ResidualDiagnostics) -> dict[str, Any]:
    """Return what run.json says of the residuals."""
    together = diagnostics.together
    return {
        "too_narrow": diagnostics.too_narrow,
        "outputs": [dataclasses.asdict(output) for output in diagnostics.outputs],
        "together": None if together is None else dataclasses.asdict(together),
        "sentences": list(residual_sentences(diagnostics)),
    }


def residual_sentences(diagnostics: ResidualDiagnostics) -> tuple[str, ...]:
    """Sentences on what is wrong with model, sigma and intervals; none where nothing is."""
    found = diagnostics.findings
    reason = "" if diagnostics.converged else "the search did not converge, or "
    missing = [o for o in found if o.structure is ResidualStructure.MISSING]
    related = [o for o in found if o.structure is ResidualStructure.AUTOCORRELATED]
    sized = [o for o in related if not o.too_narrow]
    others = [o for o in related if o.too_narrow]
    sentences = []
    if missing:
        sentences.append(
            f"{_each(missing, _over_sigma)}: these intervals are too narrow, {reason}something is "
            f"missing from the model, which they do not allow for; {ADVICE}"
        )
    if sized:
        sentences.append(
            f"{_each(sized, _no_larger)}: {reason}the sensor's noise is coloured, which the "
            f"intervals allow for, or something small is missing, which they do not; {ADVICE}"
        )
    if others:
        sentences.append(
            f"{_each(others, _times_noise)}: {reason}something is missing from the model, and "
            "these intervals are too narrow, or the sensor's noise is coloured, which they "
            f"allow for; {ADVICE}"
        )
    return (*sentences, *(_of_sigma(output) for output in found if output.sigma))


def _each(outputs: Iterable[OutputDiagnostics], say: Callable[[OutputDiagnostics], str]) -> str:
    ordered = sorted(outputs, key=lambda o: -o.rms_over_sigma)
    said = [f"{o.output}: {say(o)}" for o in ordered[:MOST_OUTPUTS]]
    more = len(ordered) - len(said)
    return "; ".join(said) + (f"; and {more} more outputs" if more > 0 else "")


def _over_sigma(output: OutputDiagnostics) -> str:
    return f"error is {output.rms_over_sigma:.2g} x sigma and {_related(output)}"


def _no_larger(output: OutputDiagnostics) -> str:
    return (
        f"residuals are {_related(output)} though hardly larger than sigma "
        f"({output.rms_over_sigma:.2g} x)"
    )


def _times_noise(output: OutputDiagnostics) -> str:
    noise = "its noise from sample to sample"
    if not output.declared:
        noise += f" ({output.noise_over_sigma:.2g}; no sigma is declared)"
    return f"error is {output.rms_over_noise:.2g} x {noise} and {_related(output)}"


def _related(output: OutputDiagnostics) -> str:
    if output.lag1 >= VISIBLE:
        return f"autocorrelated at lag 1 with {output.lag1:.2g}"
    return f"autocorrelated over about {output.length:.0f} samples (lag 1: {output.lag1:.2g})"


def _of_sigma(output: OutputDiagnostics) -> str:
    times = output.rms_over_sigma
    if output.sigma is SigmaDoubt.TOO_LARGE:
        return (
            f"{output.output}: error is {times:.2g} x sigma: the declared sigma is probably "
            f"{1.0 / times:.2g} times too large; correct it, or errors over sigma say nothing"
        )
    if output.sigma is SigmaDoubt.OUTLIERS:
        return (
            f"{output.output}: residuals are white, but the largest is "
            f"{output.largest_over_rms:.2g} times their root mean square: a few samples are "
            "outliers, or show something sudden that the model lacks; look at them, or take the "
            'cost "huber"'
        )
    if output.structure is ResidualStructure.WHITE:
        return (
            f"{output.output}: error is {times:.2g} x sigma but white: nothing points to something "
            f"missing, the declared sigma is probably {times:.2g} times too small; correct it"
        )
    noise = output.noise_over_sigma
    return (
        f"{output.output}: its noise from sample to sample alone is {noise:.2g} x sigma: the "
        f"declared sigma is probably {noise:.2g} times too small; correct it"
    )
