"""Benefit of each part of the search: a comparison of loops with and without it, case by case.

A loop is compared with the complete loop on the same case. The exact test of Q. McNemar,
Psychometrika 12 (1947) 153-157, doi:10.1007/BF02295996, tests whether it is right more or less
often than by chance. Only cases in which exactly one of the two is right count. If the part has no
influence on names, each of the two is right in half of these.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.stats import binomtest

from closed_loop_benchmark import figures as f
from closed_loop_benchmark.scoring import Score
from closed_loop_benchmark.tables import markdown, rightness
from cluster_est.closed_loop.settings import LoopPart

Runs = Mapping[str, Mapping[str, Score]]
"""Scores by omitted part and by case; the complete loop comes first."""

Pair = tuple[Score, Score]
"""A case with the complete loop, and without a part."""

HEAD = (
    "left out",
    "cases",
    "where it acts",
    "right with it",
    "right without",
    "lost",
    "won",
    "p",
    "false names",
    "held out, median",
    "worst",
    "simulations",
)

EXPLANATION = """\
Each row compares the closed loop with a loop without one part of its search, or without several at
once. Parts are moves that propose structures, gates that refuse them, and functions that moves
share ([How it works](how_it_works.md) describes each). Each case is run with and without the part.
If the part changed nothing in the whole loop, the run without it is skipped: its result is that of
the whole loop, without the simulations of the part. "Where it acts" counts the other cases.

A case is right if every effect has one of its names or the structure is the same model. If nothing
is missing, a case is right if no effect is added. If the library cannot express the effect, a case
is right if a free curve follows the held-out data with at most 1.5 times the error of the true
model. A case is "lost" if leaving out the part turns a right result into a wrong one. It is "won"
if leaving out the part turns a wrong result into a right one. "p" is the p-value of the exact
McNemar test. "False names" counts the named effects that the true system does not have: first with
the part, then without it. The held-out errors (median and largest) and the numbers of simulations
(geometric mean) are ratios: the value without the part, divided by the value with it.

All systems may be used for tuning. Pairs and triples are drawn at random from the effects of the
benchmark, in addition to those that it lists.
"""

MEASURED = """\
## Parts that only measured data need

The cases above hardly need these parts, but the [league of measured cases](league.md) does:

- Without `beam`, the search explains too little for a claim on the cascaded tanks.
- Without `other places`, `next best`, `curve ends`, `exclude`, `switched curves` and `places first`
  together, nothing is claimed on both batteries and on the pendulum of the Furuta type.
- Functions of time displace friction in a single free decay. This is why the search is repeated
  without them (`functions of time`) if they leave more than noise.
"""

DELETED_BEFORE = """\
Parts that were deleted before, measured on the search of that time:

- `lower ranks` tried more candidates if the leading ones left much. Without it, none of 47 cases
  was lost or won, with 0.82 to 0.85 times the simulations. The held-out error of the cascaded tanks
  depends on it by chance: it is 0.214 V with all of these candidates, and 0.259 V with half of them
  or none.
- `restarts` fitted an accepted structure from other starts, and `local minimum` examined the
  declared model a second time.
- `replace` replaced an effect by another one, and `merge two` replaced two effects by one.
- `merge` tried one effect or a free curve instead of all others, even if these explain the data. If
  they leave more than noise, this is still tried (`curve instead`).
- The last five, and a beam over structures of the same size, were deleted together. Of 67 cases,
  one pair was lost and none was won, with 0.583 times the simulations.
"""


def paired(runs: Runs) -> str:
    """Return a line for each omitted part, over the cases that it has finished.

    The first run is the complete loop; each other run is compared with it on the same cases.
    """
    (_, whole), *others = runs.items()
    return markdown(HEAD, [_row(label, pairs_of(whole, own)) for label, own in others])


def _row(label: str, pairs: Sequence[Pair]) -> list[str]:
    lost = [with_it for with_it, without in pairs if is_right(with_it) and not is_right(without)]
    won = [with_it for with_it, without in pairs if is_right(without) and not is_right(with_it)]
    held_out = [own.after / before.after for before, own in pairs if before.after > 0.0]
    logs = [np.log(own.simulations / before.simulations) for before, own in pairs]
    return [
        label,
        str(len(pairs)),
        str(sum(_acts(before, label) for before, _ in pairs)),
        str(sum(is_right(before) for before, _ in pairs)),
        str(sum(is_right(own) for _, own in pairs)),
        _by_kind(lost),
        _by_kind(won),
        f"{mcnemar(len(lost), len(won)):.2g}",
        f"{sum(_false_names(b) for b, _ in pairs)}, {sum(_false_names(o) for _, o in pairs)}",
        f"{np.median(held_out):.3f}" if held_out else "-",
        f"{max(held_out):.3f}" if held_out else "-",
        f"x {np.exp(np.mean(logs)):.3f}" if logs else "-",
    ]


def pairs_of(whole: Mapping[str, Score], without: Mapping[str, Score]) -> list[Pair]:
    """Return the cases that were finished both completely and without a part."""
    return [
        (whole[name], own)
        for name, own in without.items()
        if name in whole and not (own.error or whole[name].error)
    ]


def is_right(score: Score) -> bool:
    """Return whether the result of a case is right; see the explanation on the page."""
    if f.worse(score):
        return False
    if not score.true:
        return not f.changed(score)
    return f.near_truth(score) if score.kind == "outside" else f.right(score)


def mcnemar(lost: int, won: int) -> float:
    """Return the exact two-sided p-value of the numbers of cases that were lost and won."""
    return float(binomtest(lost, lost + won).pvalue) if lost + won else 1.0


def _acts(score: Score, label: str) -> bool:
    """Return whether the search used a part; True if this was not recorded."""
    return score.active is None or bool({*label.split("+")} & {*score.active})


def _by_kind(scores: Iterable[Score]) -> str:
    """Return the number of cases, and their kinds."""
    kinds = Counter(score.kind for score in scores)
    said = ", ".join(f"{kind} {count}" for kind, count in kinds.most_common())
    return f"{kinds.total()} ({said})" if said else "0"


def _false_names(score: Score) -> int:
    """Return the number of named effects that are not true effects."""
    named = len(score.named or [])
    right = named if score.numerical else sum(score.alias or [])
    return max(named - right, 0)


def parts_page(runs: Runs) -> str:
    """Return the page: a row for each part, and the cases that are right only with or without it.

    Parts that the package no longer has are listed as deleted.
    """
    (first, whole), *others = runs.items()
    kinds = Counter(score.kind for score in whole.values() if not score.error)
    cases = ", ".join(f"{count} of the kind {kind}" for kind, count in kinds.most_common())
    differing = [
        [label, before.name, *_said(before), *_said(own)]
        for label, scores in others
        for before, own in pairs_of(whole, scores)
        if is_right(before) != is_right(own)
    ]
    head = ["left out", "case", "with it", "held out", "without", "held out"]
    kept = {label: own for label, own in others if {*label.split("+")} <= {*LoopPart}}
    deleted = {label: own for label, own in others if label not in kept}
    parts = [
        "# What each part of the search is for",
        EXPLANATION,
        f"Cases so far: {cases}.",
        paired({first: whole, **kept}),
        "## Cases that are right only with a part, or only without it",
        markdown(head, differing),
        MEASURED,
        "## Parts that were deleted",
    ]
    if deleted:
        parts.append(paired({first: whole, **deleted}))
    parts.append(DELETED_BEFORE)
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


def _said(score: Score) -> list[str]:
    """Return the named effects, how right they are, and the held-out error."""
    named = "; ".join(score.named or []) or score.verdict
    return [f"{rightness(score)}: {named}", f"{score.after:.2f}"]
