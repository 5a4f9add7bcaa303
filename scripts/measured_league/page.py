"""The page of the league: one table of all cases, then each case with judgements and a picture."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatchcase
from pathlib import Path
from statistics import median

from cluster_est.closed_loop.findings.claims import CLAIMED
from cluster_est.closed_loop.selection.rounds import VERDICT
from measured_league.cases import LeagueCase
from measured_league.picture import CURVES, held_out_record, picture
from measured_league.runs import (
    CaseFigures,
    Kind,
    NamedEffect,
    RunFigures,
    read_case,
    run_folder,
)

NEAR_TEXTBOOK, NEAR_NOISE = 1.05, 1.5
"""Times the textbook's held-out error, and times the noise, that count as good."""
HONEST = ("none", "none (coloured noise)", "partial", "unexplained")
SAME = 1e-3
"""Held-out errors that differ by less than this part are the same."""

INTRODUCTION = """# The league of measured cases

`scripts/league.py` writes this page from its runs. Each run uses the default settings on one core.

Each case has a public data set and a base model from a textbook. The base model lacks one effect,
which the textbook's full model contains. `cluster-est close-loop` searches for missing effects
without knowing this effect. On this page, such a search is called a loop. The base model and the
textbook's model are fitted to the same data. Errors are root mean squares over all samples of all
outputs and records. Nothing is chosen by held-out errors; they can only veto effects. If the
initial state of a held-out record is unknown, it is fitted to the record for each of the three
models.

The splits, base models and effects were chosen with knowledge of all data. For this reason, the
difference between the base model and the textbook's model is optimistic. Any setting may have been
tuned on these cases, so a good score proves nothing about other cases.

If the config gives no `sigma`, the loop weights several outputs by its estimate of their noise,
whereas the two fits give them equal weights. Therefore, even a loop that adds nothing may have
other errors than the base model. In the following table, a loop counts as having increased the
held-out error only if it has added an effect.

By definition, a loop adds effects only if they remove at least half of the error above the noise,
both on training and on held-out data. This is three quarters of the sum of squares. Otherwise, the
verdict is `unexplained`, and the loop names the best candidate as a hint. If the textbook's own
effect does not halve the error, the verdict `unexplained` is not a failure.
"""

PATHS = """## Held-out errors along the path

The table shows the held-out error, divided by the noise, of every structure that a search accepted,
in the order of acceptance. The first structure is the base model. After it, `+` marks effects that
were added to the structure before, and `-` marks effects that were dropped from it. The base model
and the answer have the values of the last fits, and the other structures have those of the search.
The last column is the error of the answer divided by the least error of its path, which includes
the answer. A dash means that no effect was accepted, or that there is no held-out error.

This is a figure only: nothing is chosen by held-out errors. The held-out data can only veto an
answer. Then an earlier answer of the search or the base model takes its place, so after a veto, the
ratio also depends on the held-out data.
"""


def write_page(
    cases: Sequence[LeagueCase], judgements: Mapping[str, CaseJudgements], out: Path, page: Path
) -> list[Path]:
    """Write the page and its pictures.

    Parameters
    ----------
    cases
        The cases, in their order.
    judgements
        Judgements of names, by case.
    out
        The folder of the league's runs.
    page
        The Markdown file; the pictures go into a folder of its name beside it.

    Returns
    -------
    list of Path
        What was written.
    """
    found = [read_case(case, out) for case in cases]
    pictures = page.with_suffix("")
    written = []
    drawn: dict[str, str] = {}
    for each in found:
        svg = _picture(each, out)
        if svg and each.case.textbook is not None:  # the page shows no picture of official cases
            pictures.mkdir(parents=True, exist_ok=True)
            file = pictures / f"{each.case.name}.svg"
            file.write_text(svg, encoding="utf-8")
            drawn[each.case.name] = f"{pictures.name}/{file.name}"
            written.append(file)
    page.write_text(page_text(found, judgements, drawn), encoding="utf-8")
    return [page, *written]


def page_text(
    found: Sequence[CaseFigures],
    judgements: Mapping[str, CaseJudgements],
    pictures: Mapping[str, str],
) -> str:
    """The page as Markdown.

    Parameters
    ----------
    found
        The figures of all cases.
    judgements
        Judgements of names, by case.
    pictures
        The picture of each case that has one, from the page's folder.
    """
    known = {
        each.case.name: judgements.get(each.case.name, CaseJudgements("", ())) for each in found
    }
    own = [each for each in found if each.case.textbook is not None]
    parts = [INTRODUCTION.rstrip(), _summary(own, known), _all_cases(own, known), _paths(own)]
    parts += [_official(each, known[each.case.name]) for each in found if each not in own]
    parts += [_case(each, known[each.case.name], pictures) for each in own]
    return "\n\n".join(part for part in parts if part) + "\n"


def _paths(found: Sequence[CaseFigures]) -> str:
    """The held-out error of every structure that a search accepted; nothing is chosen by it."""
    rows: list[list[str]] = []
    ratios: dict[str, float] = {}
    for each in found:
        loop, name = each.loop, each.case.name
        if loop is None or not math.isfinite(loop.over_least):
            rows.append([name, "-", "-", "-"])
            continue
        ratios[name] = loop.over_least
        rows.append([name, _steps(loop.path), number(loop.answer), number(ratios[name])])
    if not ratios:
        return ""
    worst = max(ratios, key=ratios.__getitem__)
    line = (
        f"Over {len(ratios)} cases, the held-out error of the answer is "
        f"{number(median(ratios.values()))} times the least held-out error of its path (median), "
        f"and {number(ratios[worst])} times in the worst case ({worst})."
    )
    head = ["case", "structures", "answer", "answer / least"]
    return "\n\n".join((PATHS.rstrip(), line, table(head, rows)))


def _steps(path: Mapping[tuple[str, ...], float]) -> str:
    """The structures of a path with their errors, each by its difference to the one before it."""
    said: list[str] = []
    before: tuple[str, ...] = ()
    for labels, error in path.items():
        changes = [f"- `{label}`" for label in before if label not in labels]
        changes += [f"+ `{label}`" for label in labels if label not in before]
        said.append(f"{' '.join(changes) if labels else 'base model'}: {number(error)}")
        before = labels
    return "; ".join(said)


def _official(each: CaseFigures, known: CaseJudgements) -> str:
    """A case on an official split: the error of each held-out record beside published ones."""
    case = each.case
    published = dict(known.published)
    rows = [
        [record, *(number(errors.get(record, math.nan)) for errors in each.records), published_of]
        for record in each.records[-1]
        for published_of in [published.get(record, "-")]
    ]
    parts = [f"## {case.name}", case.title, known.remark]
    if each.loop:
        parts.append(_said(each))
        added = "; ".join(f"`{effect.name}`" for effect in each.loop.effects)
        parts.append(f"Added: {added}." if added else "")
    unit = each.base.unit if each.base else ""
    head = [f"record, errors in {unit}", "base", "loop", "best published"]
    return "\n\n".join(filter(None, [*parts, table(head, rows)]))


def _summary(found: Sequence[CaseFigures], known: Mapping[str, CaseJudgements]) -> str:
    """How many cases are as they should be, of those with a loop and a textbook fit."""
    ended = [each for each in found if each.loop and each.base and each.textbook]
    questions: tuple[tuple[str, Callable[[CaseFigures], bool]], ...] = (
        (
            f"the held-out error is at most {NEAR_TEXTBOOK} times that of the textbook's model",
            near_textbook,
        ),
        (
            "the loop named the textbook's effect or an alias of it",
            lambda each: named(each, known),
        ),
        (
            "the loop claimed an effect that is physically wrong",
            lambda each: claims_wrong(each, known[each.case.name]),
        ),
        ("the loop increased the held-out error", made_worse),
        (f"more than {NEAR_NOISE} times the noise remains, and the verdict says so", says_so),
        (f"more than {NEAR_NOISE} times the noise remains, but the verdict is `found`", overclaims),
        ("the textbook's effect halves the held-out error", textbook_halves),
        (
            "the textbook's effect halves the held-out error, but the verdict is `none`",
            overlooked,
        ),
    )
    rows = [[text, f"{sum(map(question, ended))} of {len(ended)}"] for text, question in questions]
    text = table(["", "cases"], rows)
    missing = [each.case.name for each in found if each not in ended]
    if missing:
        text += f"\n\nSome runs have not ended for these cases: {', '.join(missing)}."
    return text


def near_textbook(each: CaseFigures) -> bool:
    """Whether the loop predicts what was held out about as well as the textbook's effect."""
    return _loop(each).test <= NEAR_TEXTBOOK * _of(each.textbook).test


def textbook_halves(each: CaseFigures) -> bool:
    """Whether the textbook's effect is large enough for the loop to add anything like it."""
    return _of(each.textbook).test <= 0.5 * _of(each.base).test


def overlooked(each: CaseFigures) -> bool:
    """Whether the loop says that nothing is missing where the textbook knows what is."""
    return textbook_halves(each) and bool(each.loop) and _verdict(each).startswith("none")


def named(each: CaseFigures, known: Mapping[str, CaseJudgements]) -> bool:
    """Whether the loop named the effect or an alias of it."""
    return _rightness(each, known[each.case.name]) in (Rightness.RIGHT, Rightness.ALIAS)


def claims_wrong(each: CaseFigures, known: CaseJudgements) -> bool:
    """Whether an effect that the loop claims, rather than calling it a lead, is wrong."""
    effects = each.loop.effects if each.loop else ()
    claimed = [effect.name for effect in effects if effect.probability >= CLAIMED]
    return any(known.of(name).rightness is Rightness.WRONG for name in claimed)


def made_worse(each: CaseFigures) -> bool:
    """Whether the loop added something that predicts worse than the base model."""
    return bool(each.loop and each.loop.effects) and (
        _loop(each).test > (1.0 + SAME) * _of(each.base).test
    )


def more_than_noise(each: CaseFigures) -> bool:
    """Whether more than noise is left, on the training or on the held-out data."""
    loop = _loop(each)
    return max(loop.train, loop.test) > NEAR_NOISE * each.noise


def says_so(each: CaseFigures) -> bool:
    """Whether more than noise is left and the verdict claims no more than that."""
    return more_than_noise(each) and each.loop is not None and each.loop.verdict in HONEST


def overclaims(each: CaseFigures) -> bool:
    """Whether more than noise is left and the verdict is "found" all the same."""
    return more_than_noise(each) and not says_so(each)


def _all_cases(found: Sequence[CaseFigures], known: Mapping[str, CaseJudgements]) -> str:
    head = ["case", "unit", "base", "loop", "textbook", "noise", "verdict", "named"]
    rows = []
    for each in found:
        base, loop, textbook = (pair(run) for run in _runs(each))
        unit = each.base.unit if each.base else "-"
        verdict = _verdict(each)
        rightness = _rightness(each, known[each.case.name]) or "-"
        rightness = f"{rightness} (lead)" if _judged_leads(each) else rightness
        anchor = f"[{each.case.name}](#{each.case.name})"
        noise = number(each.noise)
        row = [anchor, unit, base, loop, textbook, noise, verdict, str(rightness)]
        rows.append([*row, *_cost(each.loop.figures if each.loop else None)])
    text = (
        "The columns base, loop and textbook show the errors on training / held-out data. The "
        "column named says how the best name that the loop gave was judged. If the textbook's own "
        "effect removes less than three quarters of the squared held-out error above the noise, "
        "the loop cannot add it, so if it added nothing, its first lead is judged instead."
    )
    return f"{text}\n\n{table([*head, 'simulations', 's'], rows)}"


def _case(each: CaseFigures, known: CaseJudgements, pictures: Mapping[str, str]) -> str:
    case = each.case
    parts = [
        f"## {case.name}",
        f"{case.title} The textbook adds: {case.lacking[:1].lower()}{case.lacking[1:]}",
    ]
    if known.remark:
        parts.append(known.remark)
    if each.loop:
        parts.append(_said(each))
        effects = each.loop.effects or _judged_leads(each)
        what = "added effect" if each.loop.effects else "lead that was not added"
        rows = [
            [f"`{e.name}`", f"`{e.equation}`", _sure(e), judged.rightness.value, judged.why]
            for e in effects
            for judged in [known.of(e.name)]
        ]
        if rows:
            parts.append(table([what, "equation", "probability", "judgement", "reason"], rows))
    else:
        parts.append("The search for missing effects has no result for this case.")
    if case.name in pictures:
        parts.append(f"![{case.title}]({pictures[case.name]})")
    return "\n\n".join(parts)


def _said(each: CaseFigures) -> str:
    """The verdict, and what is left of the held-out error."""
    assert each.loop is not None
    text = f"Verdict of the search for missing effects: `{each.loop.verdict}`"
    text += "." if each.loop.effects else ". No effect was added."
    loop = each.loop.figures
    others = (("base model", each.base), ("textbook's model", each.textbook))
    shares = [f"{loop.test / run.test:.2f} times that of the {name}" for name, run in others if run]
    if shares:
        text += f" The held-out error is {' and '.join(shares)}."
    if math.isfinite(each.noise):
        times = [f"{error / each.noise:.3g}" for error in (loop.train, loop.test)]
        text += (
            f" The remaining error is {times[0]} times the noise on training data "
            f"and {times[1]} times the noise on held-out data."
        )
    return text


def _picture(each: CaseFigures, out: Path) -> str:
    """The picture of a case, or "" where its base model has not been fitted."""
    there = dict(zip(CURVES, _runs(each), strict=True))
    runs = {name: run_folder(out, each.case, Kind(name)) for name, run in there.items() if run}
    if "base" not in runs:
        return ""
    return picture(held_out_record(runs), each.case.title, _of(each.base).unit)


def _runs(each: CaseFigures) -> tuple[RunFigures | None, ...]:
    """In the order of `CURVES`."""
    return each.base, each.loop.figures if each.loop else None, each.textbook


def _rightness(each: CaseFigures, known: CaseJudgements) -> Rightness | None:
    effects = each.loop.effects if each.loop else ()
    return known.overall([effect.name for effect in effects or _judged_leads(each)])


def _judged_leads(each: CaseFigures) -> tuple[NamedEffect, ...]:
    """The first lead, if nothing was added and the textbook's effect is too small to be added."""
    if not (each.loop and each.base and each.textbook) or each.loop.effects:
        return ()
    base, textbook = (run.test**2 - each.noise**2 for run in (each.base, each.textbook))
    return each.loop.leads[:1] if base - textbook < VERDICT.most * base else ()


def _sure(effect: NamedEffect) -> str:
    """The probability that an effect is right; below `CLAIMED`, it is only a lead."""
    if not math.isfinite(effect.probability):
        return "-"
    lead = "" if effect.probability >= CLAIMED else " (lead)"
    return f"{effect.probability:.0%}{lead}"


def _verdict(each: CaseFigures) -> str:
    return each.loop.verdict if each.loop else "-"


def _loop(each: CaseFigures) -> RunFigures:
    return _of(each.loop.figures if each.loop else None)


def _of(run: RunFigures | None) -> RunFigures:
    if run is None:
        raise ValueError("a case without this run was asked for its figures")
    return run


def _cost(run: RunFigures | None) -> list[str]:
    return [f"{run.simulations}", f"{run.seconds:.0f}"] if run else ["-", "-"]


def pair(run: RunFigures | None) -> str:
    """Both errors of a run, as training / held out."""
    return f"{number(run.train)} / {number(run.test)}" if run else "-"


def number(value: float) -> str:
    """Three digits, or a dash where there is no number."""
    return f"{value:.3g}" if math.isfinite(value) else "-"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(c.replace('|', '&#124;') for c in line)} |" for line in lines)


JUDGEMENTS = Path(__file__).with_name("judgements.toml")


class Rightness(StrEnum):
    """How right a name is. A member's text is what the page says."""

    RIGHT = "right"
    ALIAS = "alias"
    WRONG = "physically wrong"
    OPEN = "to be judged"


@dataclass(frozen=True)
class Judgement:
    """A judgement of all effects whose names fit a pattern with * and ?, and the reason."""

    pattern: str
    rightness: Rightness
    why: str


@dataclass(frozen=True)
class CaseJudgements:
    """What is known of a case.

    Attributes
    ----------
    remark
        What to know before its figures are believed.
    names
        Judgements; the first that fits a name counts.
    published
        The best published error of each record, as text.
    """

    remark: str
    names: tuple[Judgement, ...]
    published: tuple[tuple[str, str], ...] = ()

    def of(self, name: str) -> Judgement:
        """The judgement of an effect by its name."""
        for each in self.names:
            if fnmatchcase(name, each.pattern):
                return each
        return Judgement(name, Rightness.OPEN, "no pattern of this case fits this name")

    def overall(self, names: Sequence[str]) -> Rightness | None:
        """The best rightness among names; None where there is no name."""
        found = {self.of(name).rightness for name in names}
        for rightness in (Rightness.RIGHT, Rightness.ALIAS, Rightness.OPEN, Rightness.WRONG):
            if rightness in found:
                return rightness
        return None


def read_judgements(file: Path = JUDGEMENTS) -> dict[str, CaseJudgements]:
    """Read the judgements of all cases, by the names of these."""
    tree = tomllib.loads(file.read_text(encoding="utf-8"))
    return {
        case: CaseJudgements(
            section["remark"],
            tuple(
                Judgement(each["pattern"], Rightness(each["is"]), each["why"])
                for each in section.get("names", [])
            ),
            tuple(section.get("published", {}).items()),
        )
        for case, section in tree.items()
    }
