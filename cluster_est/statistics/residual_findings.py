"""What tests of residuals have found, for each output and for all together, and its sentences."""

from __future__ import annotations

import enum
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import numpy as np


class ResidualStructure(enum.StrEnum):
    """What the residuals look like."""

    NOT_TESTED = "not tested"
    WHITE = "white"
    AUTOCORRELATED = "autocorrelated"
    MISSING = "something is missing"


class SigmaDoubt(enum.StrEnum):
    """What the sizes of the residuals say of sigma, or of a few of them."""

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
        The FMU's name; "all outputs together" where they are pooled.
    samples
        In all training experiments.
    declared
        Whether it has a sigma that its residuals can be compared with.
    rms_over_sigma
        With the degrees of freedom that the parameters have left; over the unit of the output
        where no sigma is declared.
    noise_over_sigma
        The noise from sample to sample, see `estimate_noise`, likewise.
    largest_over_rms
        The largest residual in size, over `rms_over_sigma`.
    lag1, widening
        See `Autocorrelation`.
    p, length
        Probability that white noise looks so smooth, times the number of tests of the fit; and
        over how many samples.
    structure, sigma
        What follows.
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
        """True unless coloured noise of a declared size explains it: intervals allow for that."""
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
    outputs
        One for each output.
    together
        All outputs pooled, each over its noise; None where there is only one.
    converged
        Whether the search reached a solution: else that alone may leave structure.
    """

    outputs: tuple[OutputDiagnostics, ...]
    together: OutputDiagnostics | None = None
    converged: bool = True

    @property
    def findings(self) -> tuple[OutputDiagnostics, ...]:
        """What to warn of: each output, or all together where no single one stands out."""
        found = tuple(o for o in self.outputs if _structured(o) or o.sigma)
        if any(map(_structured, found)) or self.together is None or not _structured(self.together):
            return found
        return (*found, self.together)

    @property
    def too_narrow(self) -> bool:
        """True where the model lacks something, or may: intervals do not allow for that."""
        return any(output.too_narrow for output in self.findings)


def _structured(output: OutputDiagnostics) -> bool:
    return output.structure in (ResidualStructure.AUTOCORRELATED, ResidualStructure.MISSING)


MOST_NAMED_OUTPUTS = 4
"""Outputs in a sentence; of more, those with the largest error are named."""

ADVICE = (
    "to search for missing effects, run cluster-est close-loop CONFIG --out FOLDER, or in Python "
    "close_loop(problem)"
)


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
        noise += f" ({output.noise_over_sigma:.2g}; no sigma is declared)"
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
"""Correlation of neighbours below which it is better said over how many samples they are alike."""


def autocorrelated(lag1: float, length: float = np.nan) -> str:
    """Say how a residual is autocorrelated; `length` is that of its structure, in samples."""
    if lag1 >= LEAST_NEIGHBOUR_CORRELATION or not np.isfinite(length):
        return f"autocorrelated at lag 1 with {lag1:.2g}"
    return f"autocorrelated over about {length:.0f} samples (lag 1: {lag1:.2g})"


def small_sigma(named: str, noise: Collection[float]) -> str:
    """Say of some outputs that their noise over sigma is far above 1."""
    return (
        f"{named}: the noise from sample to sample alone is {from_to(noise)} x sigma, so the "
        f"declared sigma is probably {from_to(noise)} times too small; correct it"
    )


def large_sigma(named: str, errors: Collection[float]) -> str:
    """Say of some outputs that their errors over sigma are far below 1."""
    return (
        f"{named}: error is {from_to(errors)} x sigma, so the declared sigma is probably "
        f"{from_to([1.0 / error for error in errors])} times too large; correct it, because "
        "otherwise errors over sigma have no meaning"
    )


def from_to(factors: Collection[float]) -> str:
    """Write the range of some factors: "2 to 10", or one of them where all are the same."""
    ends = (min(factors), max(factors))
    least, most = (f"{end:.2g}" if end < 99.5 else f"{end:.0f}" for end in ends)
    return least if least == most else f"{least} to {most}"
