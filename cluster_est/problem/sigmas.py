"""Whether the noise of outputs is known: a sigma is given, and it is not a guess or a weight."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from workers.messages import Experiment, Output


def guessed_outputs(outputs: Iterable[Output]) -> set[str]:
    """Return the outputs with a sigma that is a guess, or that is missing in some experiments.

    A known sigma in one experiment does not make those of the other experiments known.
    """
    measured = [output for output in outputs if len(output.times)]
    known = {output.variable for output in measured if output.has_sigma}
    return {
        output.variable
        for output in measured
        if not (output.has_sigma if output.variable in known else output.sigma_known)
    }


def declares_sigma(outputs: Iterable[Output]) -> bool:
    """Return whether sigmas are declared: at least one is not 1, and none is a guess."""
    given = tuple(outputs)
    return any(output.has_sigma for output in given) and not guessed_outputs(given)


def mixed_sigmas(experiments: Sequence[Experiment]) -> Iterator[tuple[str, str]]:
    """Yield a sentence and an advice for each output whose sigma is known in some experiments."""
    pairs = [(e, o) for e in experiments if e.role == "train" for o in e.outputs if len(o.times)]
    for name in sorted(guessed_outputs(output for _, output in pairs)):
        own = [pair for pair in pairs if pair[1].variable == name]
        known = [run.record_id for run, output in own if output.has_sigma]
        others = [run.record_id for run, output in own if not output.has_sigma]
        if known:
            yield (
                f"the sigma of {name} is known in experiment {known[0]}, but in experiment "
                f"{others[0]} it is missing (or 1), a guess or a weight, so it counts as a guess "
                "in all of them, and errors are compared with the noise estimated from the data",
                "give every experiment its sigma, without sigma_known = false",
            )
