"""Loops on a case with a subset of the library, with or without the forms of the answer.

With the answer, more forms must not give a worse result than fewer. Without it, the loop meets an
effect that it cannot name, as often on measured data. Its claims are then mostly wrong, which shows
the value of a claim.
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
"""Names of all forms; a form may exist for several sites."""

WORSE = 1.05
"""Ratio of held-out errors above which a loop is worse than the loop with fewer forms."""


@dataclass(frozen=True)
class FormSubset:
    """Forms to try on a case, drawn by the case's name and a number.

    Attributes
    ----------
    sort
        "with": those of the answer, and half of the others. "lacking": all but those of one of the
        missing effects.
    number
        Number of the draw.
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
    """Return whether a form of the library belongs to one of the names in the benchmark."""
    called = {BENCHMARK_NAMES.get(form, form), form} | ({"end_stop"} if form == "gap" else set())
    return bool(called & {name[0] for name in names})


def violations(runs: Mapping[str, Mapping[str, Score]]) -> tuple[str, int]:
    """Return the cases in which all forms gave a worse result than some, and their number.

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
