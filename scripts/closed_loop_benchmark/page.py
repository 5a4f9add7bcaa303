"""The benchmark's Markdown page."""

from __future__ import annotations

from collections.abc import Sequence

from closed_loop_benchmark import table as t
from closed_loop_benchmark.ablation import Runs, ablation
from closed_loop_benchmark.scoring import Score

EXPLANATION = """\
A case counts as detectable if the true structure, refitted, lowers the sum of squares (in standard
deviations of the noise) by at least 40. A name is right if it is the effect's own, an algebraic
alias of it, or if the structure refitted to the outputs without noise misses them by less than 0.1
sigma ("numerical"); the bar counts all three. Near the limit of detection that is easily met, and
a form with more coefficients may hold the true one as a special case; "strictly" only counts other
names that also carry 96 % of what the effect changes, with no more coefficients than it has. A
site is right if it is that of one of the effect's algebraic names. Held-out errors are root mean
squares in standard deviations of the noise; the oracle is the true structure refitted, or the truth
itself where the library cannot express it. "From a textbook" are effects that were chosen by
physics, whether the library has their form or not. Where the verdict is "found", the sets of
effects that hold 90 % of the probability should hold the truth, by its own name or an algebraic
alias, in about as many cases. Thresholds may be tuned on the systems of the first table, never on
those of the second.
"""


VARIANTS = """\
The same cases in every line. Names are right as above; "outside" counts what the library cannot
express and a free curve brought to within 1.5 times the truth's held-out error, "claimed" effects
where nothing is missing but noise or a disturbance, "worse" a held-out error that grew.
"""


def page(scores: Sequence[Score], runs: Runs) -> str:
    """Write the page.

    Parameters
    ----------
    scores
        Every scored case, in any order.
    runs
        Of variants of the search that are compared; empty for none.

    Returns
    -------
    str
        Markdown.
    """
    ordered = sorted(scores, key=lambda s: (s.split != "tune", s.system, s.kind, s.name))
    parts = ["# Closed-loop benchmark", EXPLANATION]
    for split, title in (("tune", "Systems tuned on"), ("report", "Systems only reported on")):
        own = [s for s in ordered if s.split == split]
        if own:
            parts += [f"## {title}", f"{', '.join(sorted({s.system for s in own}))}."]
            parts += [t.bars(own), "By likelihood ratio, one effect:", t.by_ratio(own)]
            parts += ["Outside the library, and disturbances:", t.verdicts(own)]
            parts += ["Systems, one effect, detectable:", t.by_system(own)]
    if runs:
        parts += ["## Parts of the search switched off", VARIANTS, ablation(runs)]
    parts += ["## Every case", t.every_case(ordered)]
    failed = [s for s in ordered if s.error]
    if failed:
        parts += ["## Failures", t.failures(failed)]
    return "\n\n".join(part.rstrip() for part in parts) + "\n"
