"""Loops on a case with some forms of the library alone: with the answer among them, or without it.

With the answer, more forms must not lead to a weaker result than fewer. Without it, the loop stands
before something that it cannot name, as it often does on measured data: what it claims all the same
is mostly wrong, and shows what a claim is worth.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from closed_loop_benchmark.naming import BENCHMARK_NAMES
from closed_loop_benchmark.parts import is_right, pairs_of
from closed_loop_benchmark.scenarios import Scenario
from closed_loop_benchmark.scoring import Score
from workers.effects.forms import FORMS

LIBRARY = tuple(dict.fromkeys(name for _, name in FORMS))
"""Names of all forms; one may stand at several sites."""

WORSE = 1.05
"""Held-out error over that of the loop with fewer forms, above which a loop is worse."""


@dataclass(frozen=True)
class FormSubset:
    """Forms to try on a case, drawn by its name and a number.

    Attributes
    ----------
    sort
        "with": those of the answer, and half of the others. "lacking": all but those of one of the
        effects that are missing.
    number
        Of the draw.
    """

    sort: Literal["with", "lacking"]
    number: int

    @property
    def label(self) -> str:
        """Its name in files."""
        return f"{self.sort} {self.number}"

    def forms(self, case: Scenario) -> tuple[str, ...]:
        """Return the names of the forms."""
        random = np.random.default_rng(zlib.crc32(f"{case.name}/{self.label}".encode()))
        if self.sort == "lacking":
            lost = case.accepted[random.integers(len(case.accepted))] if case.accepted else ()
            return tuple(name for name in LIBRARY if not _is_of(name, lost))
        answer = [name for own in case.accepted for name in own]
        drawn = random.random(len(LIBRARY)) < 0.5
        kept = zip(LIBRARY, drawn.tolist(), strict=True)
        return tuple(name for name, half in kept if half or _is_of(name, answer))


def _is_of(form: str, names: Iterable[Sequence[str]]) -> bool:
    """Return whether the library's form is that of one of the names in the benchmark."""
    called = {BENCHMARK_NAMES.get(form, form), form} | ({"end_stop"} if form == "gap" else set())
    return bool(called & {name[0] for name in names})


def violations(runs: Mapping[str, Mapping[str, Score]]) -> tuple[str, int]:
    """List the cases in which all forms led to less than some of them, and count them.

    A right answer is lost, or the held-out error is larger by more than `WORSE`.
    """
    (_, whole), *others = runs.items()
    lines, looked = [], 0
    for label, own in others:
        if not label.startswith("with "):
            continue
        for all_forms, some in pairs_of(whole, own):
            looked += 1
            lost = is_right(some) and not is_right(all_forms)
            if lost or all_forms.after > WORSE * some.after:
                said = f"{'; '.join(all_forms.named or []) or all_forms.verdict}"
                with_some = f"{'; '.join(some.named or []) or some.verdict}"
                lines.append(
                    f"{'lost ' if lost else 'worse'} {some.name}: {said} ({all_forms.after:.3f}), "
                    f"{label}: {with_some} ({some.after:.3f})"
                )
    lines.append(f"{len(lines)} of {looked} loops with some forms are better than with all")
    return "\n".join(lines), len(lines) - 1
