"""The benchmark's page and its tables, and a comparison of two executions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from closed_loop_benchmark import figures as f
from closed_loop_benchmark.scoring import Score

CLASSES = (-np.inf, 15.0, 40.0, 100.0, 400.0, 3000.0, np.inf)
"""Limits of the classes of likelihood ratio."""


def bars(scores: Sequence[Score]) -> str:
    """Return the requirements on the method, and its figures."""
    clean, pairs = f.kinds(scores, "clean"), f.detectable(f.kinds(scores, "pair"))
    foreign = f.kinds(scores, "outside", "disturbance")
    triples = f.detectable(f.kinds(scores, "triple"))
    ended = [s for s in scores if not s.error]
    likely = [s for s in f.detectable(ended) if f.has_probabilities(s)]
    false = sum(map(f.found, clean))
    bound = 100.0 * f.upper_bound(false, len(clean))
    rows = [
        ['false "found", nothing missing', "<= 1 %", f.share(clean, f.found)],
        ["the same, 95 % bound (Clopper-Pearson)", "", f"{bound:.1f} %"],
        ["any effect reported, white noise", "", f.share(_noise(clean, False), f.changed)],
        ["any effect reported, coloured noise", "", f.share(_noise(clean, True), f.changed)],
        *_one_effect(f.detectable(f.kinds(scores, "single", "coloured"))),
        ["two effects: both", ">= 70 %", f.share(pairs, f.right)],
        ["two effects: at least one", ">= 92 %", f.share(pairs, f.one_right)],
        ["three effects: all", ">= 60 %", f.share(triples, f.right)],
        *_textbook(f.detectable(f.kinds(scores, "textbook"))),
        *_untidy(f.kinds(scores, "process noise", "outliers")),
        ["90 % of the probability holds the truth", "85 to 95 %", f.share(likely, f.holds_truth)],
        ["95 % intervals of coefficients that hold the truth", ">= 90 %", f.covered(ended)],
        ["outside, disturbances: refused or better", ">= 90 %", f.share(foreign, f.honest)],
        ["held-out error made worse", "0", f.share(ended, f.worse)],
        ["by more than 2 %", "", f.share(ended, f.much_worse)],
        ["cases that failed, in no other row", "0", f.share(scores, lambda s: bool(s.error))],
        ["simulations, median of all", "<= 2000", f.median((s.simulations for s in ended), ".0f")],
        ["simulations, of 95 % at most", "<= 15000", f.most_of(s.simulations for s in ended)],
        ["seconds, median of all", "", f.median((s.seconds for s in ended), ".1f")],
    ]
    return markdown(["", "bar", "figure"], rows)


def _one_effect(scores: Sequence[Score]) -> list[list[str]]:
    """Return the rows about one detectable effect, in white and in coloured noise."""
    coloured = [s for s in scores if s.kind == "coloured"]
    expressible = [s for s in scores if s.has_oracle]
    return [
        ["one effect: detected", ">= 98 %", f.share(scores, f.detected)],
        ["own name", "", f.share(scores, f.exact)],
        ["own name or algebraic alias", "", f.share(scores, f.alias)],
        ["numerical alias", "", f.share(scores, f.numerical)],
        ["right: any of these", ">= 92 %", f.share(scores, f.right)],
        ["the same, strictly", "", f.share(scores, f.strictly_right)],
        ["the same where the library can express it", "", f.share(expressible, f.right)],
        ["the same in coloured noise", "", f.share(coloured, f.right)],
        ["form and site, any variable", "", f.share(scores, f.form_and_site)],
        ["among those within 2 of the criterion", "", f.share(scores, f.tied)],
        ["among those within 10 of the criterion", "", f.share(scores, f.plausible)],
        ["site", ">= 90 %", f.share(scores, f.any_site)],
        ["site of the own name", "", f.share(scores, f.site)],
        ["more than one effect", "", f.share(scores, f.more)],
        ["held-out error over oracle, median", "<= 1.02", f.median(map(f.gap, scores))],
        ["held-out error within 2 % of oracle", "", f.share(scores, lambda s: f.gap(s) <= 1.02)],
        ["parameters' error before, median", "", f.median(s.parameters_before for s in scores)],
        ["parameters' error after, median", "", f.median(s.parameters_after for s in scores)],
    ]


def _textbook(scores: Sequence[Score]) -> list[list[str]]:
    """Return the rows about one detectable effect from a textbook."""
    return [
        ["from a textbook: detected", ">= 99 %", f.share(scores, f.detected)],
        ["right, strictly", ">= 96 %", f.share(scores, f.strictly_right)],
        ["right place: site and variable", ">= 96 %", f.share(scores, f.place)],
        ["more than one effect", "<= 3 %", f.share(scores, f.more)],
        ["held-out error within 1.5 of the truth's", ">= 70 %", f.share(scores, f.near_truth)],
    ]


def _untidy(scores: Sequence[Score]) -> list[list[str]]:
    """Return the rows about process noise and outliers."""
    nothing = [s for s in scores if not s.true]
    present = [s for s in scores if s.true]
    return [
        ["process noise, outliers, nothing missing: any effect", "", f.share(nothing, f.changed)],
        ["the same with an effect: right", "", f.share(present, f.right)],
    ]


def by_ratio(scores: Sequence[Score]) -> str:
    """Return the shares of detected and named effects as a function of the likelihood ratio."""
    head = ["likelihood ratio", "n", "before on train", *NAMING, "before -> after (oracle)"]
    rows, single = [], f.kinds(scores, "single", "coloured")
    for low, high in pairwise(CLASSES):
        own = [s for s in single if low <= s.likelihood_ratio < high]
        label = f"{low:g} to {high:g}"
        label = f"< {high:g}" if low == -np.inf else f">= {low:g}" if high == np.inf else label
        seen = f.median((s.train_before for s in own), ".2f")
        rows.append([label, str(len(own)), seen, *_naming(own), _held_out(own)])
    return markdown(head, rows)


def by_system(scores: Sequence[Score]) -> str:
    """Return the shares of detected and named effects for each system."""
    head = ["system", "n", *NAMING, "over oracle", "simulations", "seconds"]
    rows, single = [], f.detectable(f.kinds(scores, "single", "coloured"))
    for system in sorted({s.system for s in single}):
        own = [s for s in single if s.system == system]
        cost = [f.median((s.simulations for s in own), ".0f")]
        cost += [f.median((s.seconds for s in own), ".1f")]
        rows.append([system, str(len(own)), *_naming(own), f.median(map(f.gap, own)), *cost])
    return markdown(head, rows)


def verdicts(scores: Sequence[Score]) -> str:
    """Return the verdicts without a right name, and with nothing missing."""
    kinds: tuple[tuple[str, Callable[[Score], bool]], ...] = (
        ("outside", lambda s: s.kind == "outside"),
        ("disturbance", lambda s: s.kind == "disturbance"),
        ("textbook", lambda s: s.kind == "textbook"),
        ("process noise", lambda s: s.kind == "process noise" and not s.true),
        ("outliers", lambda s: s.kind == "outliers" and not s.true),
        ("clean, white noise", lambda s: s.kind == "clean" and not s.correlation),
        ("clean, coloured noise", lambda s: s.kind == "clean" and s.correlation > 0.0),
        ("one effect", lambda s: s.kind in ("single", "coloured")),
        ("two effects", lambda s: s.kind == "pair"),
        ("three effects", lambda s: s.kind == "triple"),
    )
    ended = [s for s in scores if not s.error]
    said = sorted({s.verdict for s in ended})
    rows = []
    for label, belongs in kinds:
        own = [s for s in ended if belongs(s)]
        counts = Counter(s.verdict for s in own)
        rows.append([label, str(len(own)), *(str(counts[v]) for v in said), _held_out(own)])
    return markdown(["", "n", *said, "before -> after (oracle)"], rows)


def every_case(scores: Iterable[Score]) -> str:
    """Return one line for each case."""
    head = ["case", "LR", "verdict", "named", "right", "before -> after (oracle)"]
    return markdown([*head, "simulations", "s"], [_case(s) for s in scores if not s.error])


def failures(scores: Iterable[Score]) -> str:
    """Return the errors, with the last line of each traceback."""
    return markdown(["case", "error"], [[s.name, s.error.splitlines()[-1]] for s in scores])


def one_line(score: Score) -> str:
    """Return a case as text for a terminal."""
    if score.error:
        return f"{score.name}: {score.error.splitlines()[-1]}"
    name, ratio, verdict, named, right, errors, simulations, seconds = _case(score)
    return (
        f"{name:46s} LR {ratio:>8s}  {verdict:24s} {right:10s} {errors:24s} "
        f"{simulations:>6s} sim {seconds:>6s} s  {named}"
    )


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(c.replace('|', '&#124;') for c in line)} |" for line in lines)


NAMING = ("detected", "own name", "or alias", "or numerical", "within 10", "site")


def _naming(scores: Sequence[Score]) -> list[str]:
    questions = (f.detected, f.exact, f.alias, f.right, f.plausible, f.any_site)
    return [f.percent(scores, question) for question in questions]


def _held_out(scores: Sequence[Score]) -> str:
    before, after, oracle = (
        f.median((getattr(s, field) for s in scores), ".2f")
        for field in ("before", "after", "oracle")
    )
    return f"{before} -> {after} ({oracle})"


def _noise(scores: Iterable[Score], coloured: bool) -> list[Score]:
    return [s for s in scores if (s.correlation > 0.0) == coloured]


def _case(score: Score) -> list[str]:
    return [
        score.name,
        str(round(score.likelihood_ratio)) if np.isfinite(score.likelihood_ratio) else "-",
        score.verdict,
        "; ".join(score.named or []) or "-",
        rightness(score),
        f"{score.before:.2f} -> {score.after:.2f} ({score.oracle:.2f})",
        f"{score.simulations:.0f}",
        f"{score.seconds:.1f}",
    ]


def rightness(score: Score) -> str:
    """Return in a word or two how right the names are."""
    if f.worse(score):
        return "worse"
    if not score.true and score.kind != "disturbance":
        return "false" if f.changed(score) else "-"
    if score.kind in ("outside", "disturbance"):
        return "better" if f.changed(score) else "-"
    for word, question in (
        ("exact", f.exact),
        ("alias", f.alias),
        ("numerical", f.right),
        ("one of two", f.one_right),
        ("tied", f.tied),
        ("plausible", f.plausible),
        ("site", f.any_site),
    ):
        if question(score):
            return word
    return "no" if f.changed(score) else "-"


def holds(score: Score) -> bool:
    """Return whether the result of a case is right.

    For a case without an effect, nothing may be claimed, and the held-out error must not increase.
    An effect must have one of its names, or be the same model on the data. If the library cannot
    express the truth, every result that does not increase the held-out error is right.
    """
    if score.error or f.worse(score):
        return False
    if not score.true:
        return not f.changed(score)
    return f.right(score) or score.kind == "outside"


def compare_runs(old: Mapping[str, Score], new: Mapping[str, Score]) -> tuple[str, int]:
    """Compare the cases that both executions have.

    Returns
    -------
    str
        A line for each case that is no longer right, with both results, the names of the cases that
        have become right, and the counts.
    int
        Number of cases that are no longer right.
    """
    both = [name for name in old if name in new]
    lost = [name for name in both if holds(old[name]) and not holds(new[name])]
    won = [name for name in both if holds(new[name]) and not holds(old[name])]
    lines = [
        line
        for name in lost
        for line in (f"was {one_line(old[name])}", f"is  {one_line(new[name])}", "")
    ]
    lines += [f"now right: {name}" for name in won]
    right = sum(holds(old[name]) for name in both), sum(holds(new[name]) for name in both)
    lines.append(
        f"{len(both)} cases in both: right {right[0]} -> {right[1]}, "
        f"no longer right {len(lost)}, now right {len(won)}"
    )
    return "\n".join(lines), len(lost)


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


def page(scores: Sequence[Score]) -> str:
    """Return the page.

    Parameters
    ----------
    scores
        Every scored case, in any order.

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
            parts += [bars(own), "By likelihood ratio, one effect:", by_ratio(own)]
            parts += ["Outside the library, and disturbances:", verdicts(own)]
            parts += ["Systems, one effect, detectable:", by_system(own)]
    parts += ["## Every case", every_case(ordered)]
    failed = [s for s in ordered if s.error]
    if failed:
        parts += ["## Failures", failures(failed)]
    return "\n\n".join(part.rstrip() for part in parts) + "\n"
