"""Findings of residual tests, for each output and for all outputs together, and their sentences."""

from __future__ import annotations

import enum
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np


class ResidualStructure(enum.StrEnum):
    """The structure of the residuals."""

    NOT_TESTED = "not tested"
    WHITE = "white"
    AUTOCORRELATED = "autocorrelated"
    MISSING = "something is missing"


class SigmaDoubt(enum.StrEnum):
    """Whether the sizes of the residuals contradict sigma, or show outliers."""

    NONE = ""
    TOO_SMALL = "sigma too small"
    TOO_LARGE = "sigma too large"
    OUTLIERS = "outliers"


@dataclass(frozen=True)
class OutputDiagnostics:
    """The training residuals of one output, of all records together.

    Attributes
    ----------
    output
        The FMU's name of the output; "all outputs together" for the pooled outputs.
    samples
        Number of samples in all training experiments.
    declared
        Whether the output has a declared sigma.
    rms_over_sigma
        Root mean square of the residuals over sigma. The sum of squares is divided by the degrees
        of freedom. Without a declared sigma, sigma is only the weight of the output, usually 1.
    noise_over_sigma
        The noise from sample to sample (`estimate_noise`), in the same unit.
    largest_over_rms
        The largest absolute residual, over `rms_over_sigma`.
    lag1, widening
        See `Autocorrelation`.
    p, length
        Probability that white noise is as smooth as the residuals, times the number of tests of the
        fit; length of the smooth structure in samples.
    structure, sigma
        The conclusions from these numbers.
    """

    output: str
    samples: int
    declared: bool
    rms_over_sigma: float
    noise_over_sigma: float
    largest_over_rms: float
    lag1: float
    widening: float
    p: float
    length: float
    structure: ResidualStructure
    sigma: SigmaDoubt

    @property
    def too_narrow(self) -> bool:
        """Whether the intervals are too narrow because of structure in the residuals.

        They are not if coloured noise of the declared sigma explains it: intervals allow for that.
        """
        if self.structure is ResidualStructure.AUTOCORRELATED:
            return not self.declared or bool(self.sigma)
        return self.structure is ResidualStructure.MISSING

    @property
    def rms_over_noise(self) -> float:
        return self.rms_over_sigma / self.noise_over_sigma if self.noise_over_sigma else np.nan


@dataclass(frozen=True)
class ResidualDiagnostics:
    """The training residuals of a fit.

    Attributes
    ----------
    together
        All outputs pooled, each divided by its noise; None if there is only one output.
    converged
        Whether the search converged; otherwise the search alone may cause structure.
    """

    outputs: tuple[OutputDiagnostics, ...]
    together: OutputDiagnostics | None = None
    converged: bool = True

    @property
    def findings(self) -> tuple[OutputDiagnostics, ...]:
        """The outputs to warn of, and all outputs together if only these show structure."""
        found = tuple(o for o in self.outputs if _structured(o) or o.sigma)
        if any(map(_structured, found)) or self.together is None or not _structured(self.together):
            return found
        return (*found, self.together)

    @property
    def too_narrow(self) -> bool:
        """Whether the model lacks something or may lack it; intervals do not allow for that."""
        return any(output.too_narrow for output in self.findings)


def _structured(output: OutputDiagnostics) -> bool:
    return output.structure in (ResidualStructure.AUTOCORRELATED, ResidualStructure.MISSING)


MOST_NAMED_OUTPUTS = 4
"""Largest number of outputs in a sentence; those with the largest errors are named."""

ADVICE = (
    "to search for missing effects, use cluster-est close-loop, or in Python close_loop(problem)"
)


def residual_sentences(diagnostics: ResidualDiagnostics, blamed: str = "") -> tuple[str, ...]:
    """Return sentences on errors of the model, sigmas and intervals; none if there are none.

    `blamed` is another cause that is known, such as "the clock is wrong, or ".
    """
    found = diagnostics.findings
    reason = blamed + ("" if diagnostics.converged else "the search did not converge, or ")
    missing = [o for o in found if o.structure is ResidualStructure.MISSING]
    related = [o for o in found if o.structure is ResidualStructure.AUTOCORRELATED]
    sized = [o for o in related if not o.too_narrow]
    others = [o for o in related if o.too_narrow]
    sentences = []
    if missing:
        sentences.append(
            f"{_each(missing, _over_sigma)}: {reason}something is missing from the model, so these "
            f"intervals are too narrow; {ADVICE}"
        )
    if sized:
        sentences.append(
            f"{_each(sized, _no_larger)}: {reason}the sensor noise is coloured (the intervals "
            "allow for that), or something small is missing (the intervals do not allow for that); "
            f"{ADVICE}"
        )
    if others:
        sentences.append(
            f"{_each(others, _times_noise)}: {reason}something is missing from the model (then "
            "these intervals are too narrow), or the sensor noise is coloured (the intervals allow "
            f"for that); {ADVICE}"
        )
    return (*sentences, *(_of_sigma(output) for output in found if output.sigma))


def _each(outputs: Iterable[OutputDiagnostics], say: Callable[[OutputDiagnostics], str]) -> str:
    ordered = sorted(outputs, key=lambda o: -o.rms_over_sigma)
    said = [f"{o.output}: {say(o)}" for o in ordered[:MOST_NAMED_OUTPUTS]]
    more = len(ordered) - len(said)
    return "; ".join(said) + (f"; and {more} more outputs" if more > 0 else "")


def _over_sigma(output: OutputDiagnostics) -> str:
    return f"error is {output.rms_over_sigma:.2g} x sigma and {_related(output)}"


def _no_larger(output: OutputDiagnostics) -> str:
    return (
        f"residuals are {_related(output)}, although hardly larger than sigma "
        f"({output.rms_over_sigma:.2g} x sigma)"
    )


def _times_noise(output: OutputDiagnostics) -> str:
    noise = "its noise from sample to sample"
    if not output.declared:
        noise += " (no sigma is declared)"
    return f"error is {output.rms_over_noise:.2g} x {noise} and {_related(output)}"


def _related(output: OutputDiagnostics) -> str:
    return autocorrelated(output.lag1, output.length)


def _of_sigma(output: OutputDiagnostics) -> str:
    times = from_to([output.rms_over_sigma])
    if output.sigma is SigmaDoubt.TOO_LARGE:
        return large_sigma(output.output, [output.rms_over_sigma])
    if output.sigma is SigmaDoubt.OUTLIERS:
        return (
            f"{output.output}: residuals are white, but the largest is "
            f"{output.largest_over_rms:.2g} times their root mean square: either a few samples are "
            "outliers, or they show a sudden event that the model lacks; check these samples, or "
            'use the cost "huber"'
        )
    if output.structure is ResidualStructure.WHITE:
        return (
            f"{output.output}: error is {times} x sigma but white, so nothing seems to be missing "
            f"from the model; the declared sigma is probably {times} times too small; correct it"
        )
    return small_sigma(output.output, [output.noise_over_sigma])


LEAST_NEIGHBOUR_CORRELATION = 0.1
"""Correlation of neighbouring samples below which a sentence gives the length of the structure."""


def autocorrelated(lag1: float, length: float = np.nan) -> str:
    """Describe the autocorrelation of a residual; `length` is its length in samples."""
    if lag1 >= LEAST_NEIGHBOUR_CORRELATION or not np.isfinite(length):
        return f"autocorrelated at lag 1 with {lag1:.2g}"
    return f"autocorrelated over about {length:.0f} samples (lag 1: {lag1:.2g})"


def small_sigma(named: str, noise: Collection[float], experiments: Sequence[str] = ()) -> str:
    """Return a sentence on outputs with noise far above sigma; `noise` is in units of sigma.

    `experiments` are those whose sigma is too small; by default all.
    """
    do = f"multiply it by {from_to(noise)} (key sigma in the experiments)"
    if experiments:
        do = f"correct it in {', '.join(map(repr, experiments))}"
    return (
        f"{named}: the noise is about {from_to(noise)} times the declared sigma, so the declared "
        f"sigma is probably too small; {do} and run again"
    )


def large_sigma(named: str, errors: Collection[float]) -> str:
    """Return a sentence on outputs with errors far below sigma; `errors` are in units of sigma."""
    return (
        f"{named}: error is {from_to(errors)} x sigma, so the declared sigma is probably "
        f"{from_to([1.0 / error for error in errors])} times too large; correct it, because "
        "otherwise errors over sigma have no meaning"
    )


def from_to(factors: Collection[float]) -> str:
    """Write the range of factors: "2 to 10", or one number if all factors are the same."""
    ends = (min(factors), max(factors))
    least, most = (f"{end:.2g}" if end < 99.5 else f"{end:.0f}" for end in ends)
    return least if least == most else f"{least} to {most}"
