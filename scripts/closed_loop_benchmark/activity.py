"""Detection of the parts of a search that influenced the result of a loop.

    with noted_parts() as notes:
        close_loop(problem)

A gate counts if it refuses something. A move counts if its proposal is accepted, or may have been.
The search is deterministic. So without the other parts, its result is the same, with fewer
simulations, apart from a few repeated ones. Parts with unknown consequences count as active.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import patch

from cluster_est.closed_loop import search
from cluster_est.closed_loop.fitter import Fitter
from cluster_est.closed_loop.screening import screen
from cluster_est.closed_loop.screening.places import rank_places
from cluster_est.closed_loop.selection import answer, argument_functions, gates, moves
from cluster_est.closed_loop.selection.acceptance import is_usable
from cluster_est.closed_loop.selection.argument_functions import refit_siblings
from cluster_est.closed_loop.selection.rounds import RoundEnd, RoundStart, SelectionResult
from cluster_est.closed_loop.settings import LoopPart

Calls = Callable[..., Any]

LAST_RESORT = {
    move.part
    for move in moves.MOVES
    if move.preferred in (moves.own_if_it_won, moves.better_of_free)
}
"""Moves without influence if their proposals do not win."""

WATCHED = {
    *LAST_RESORT,
    LoopPart.BEAM,
    LoopPart.NEXT_BEST,
    LoopPart.ADD_TWO,
    LoopPart.ANSWER,
    LoopPart.STRENGTHS,
    LoopPart.SIBLINGS,
    LoopPart.CURVE_INSTEAD,
    LoopPart.SWITCHED_CURVES,
    LoopPart.OTHER_PLACES,
    LoopPart.OTHER_FORMS,
    LoopPart.PLACES_FIRST,
    LoopPart.DROP,
    LoopPart.SWITCH_WIDTHS,
    LoopPart.BOUNDED,
    *(each.part for each in (*gates.STOPS, *gates.FILTERS, *gates.GATES)),
} - {LoopPart.OUT_OF_REACH}
"""Parts whose influence is detected; other parts count as active. `OUT_OF_REACH` also prunes."""

ANOTHER_LOOP = 1e9
"""Offset between the simulation counts of two fitters, because each counts from 0."""


@dataclass
class PartNotes:
    """Activity of the parts of a search.

    Attributes
    ----------
    active
        The parts without which the result might have been different.
    spans
        For each call of a part: its name, and the simulations before it and after it.
    """

    active: set[str] = field(default_factory=lambda: {*LoopPart} - WATCHED)
    spans: list[tuple[str, float, float]] = field(default_factory=list)
    _meters: list[object] = field(default_factory=list)

    def watched(self, part: LoopPart | None, call: Calls, changes: Calls) -> Calls:
        """Return a function that records its simulations, and whether its result has an influence.

        Parameters
        ----------
        part
            None for a part that cannot be omitted.
        call
            A function with a fitter among its arguments, or without simulations.
        changes
            Returns whether a result has an influence, from the result and the arguments.
        """
        if part is None:
            return call

        def noted(*given: Any, **named: Any) -> Any:
            fitter = next((each for each in given if isinstance(each, Fitter)), None)
            before = self._simulations(fitter)
            answer = call(*given, **named)
            after = self._simulations(fitter)
            if after > before:
                self.spans.append((part.value, before, after))
            if changes(answer, *given):
                self.active.add(part)
            return answer

        return noted

    def chosen(self, *given: Any) -> RoundEnd:
        """Choose a set; candidates after the best one count unless it was refused alone."""
        end = gates.choose(*given)
        refused = [part for part in end.stopped.values() if part in gates.OF_ONE_STRUCTURE]
        if len(refused) > (end.won is None):
            self.active.add(LoopPart.NEXT_BEST)
        return end

    def _simulations(self, fitter: Fitter | None) -> float:
        if fitter is None:
            return 0.0
        if not any(meter is fitter.meter for meter in self._meters):
            self._meters.append(fitter.meter)
        number = next(n for n, meter in enumerate(self._meters) if meter is fitter.meter)
        return number * ANOTHER_LOOP + fitter.meter.full


def saved(spans: list[tuple[str, float, float]], parts: set[str]) -> float:
    """Return the simulations of all calls of some parts; nested calls count once."""
    own = sorted((begin, end) for part, begin, end in spans if part in parts)
    total, last = 0.0, 0.0
    for begin, end in own:
        total += max(end - max(begin, last), 0.0)
        last = max(last, end)
    return total


@contextmanager
def noted_parts() -> Iterator[PartNotes]:
    """Record the activity of the parts of a search while the context lasts."""
    notes = PartNotes()
    with ExitStack() as patches:
        for owner, others in _patches(notes).items():
            patches.enter_context(patch.multiple(owner, **others))
        yield notes


def _patches(notes: PartNotes) -> Mapping[Any, dict[str, Any]]:
    """Return the replacements of functions, by module or class."""
    watched, part = notes.watched, LoopPart
    widths = watched(
        part.SWITCH_WIDTHS, moves.release_widths, lambda left, *given: left is not given[2]
    )
    siblings = watched(part.SIBLINGS, refit_siblings, _any_found)
    return {
        gates: {
            "STOPS": [replace(s, refuses=watched(s.part, s.refuses, _said)) for s in gates.STOPS],
            "GATES": [replace(g, refuses=watched(g.part, g.refuses, _said)) for g in gates.GATES],
            "FILTERS": [replace(f, kept=watched(f.part, f.kept, _left_out)) for f in gates.FILTERS],
            "is_usable": watched(part.BOUNDED, is_usable, lambda usable, *_: not usable),
        },
        moves: {
            "refit_siblings": siblings,
            "release_widths": widths,
            "_other_forms": watched(part.OTHER_FORMS, moves._other_forms, _any_found),
            "distinct": watched(part.BEAM, moves.distinct, _any_found),
        },
        argument_functions: {
            "refit_siblings": siblings,
            "switched_curves": watched(
                part.SWITCHED_CURVES, argument_functions.switched_curves, _any_found
            ),
            "_in_other_places": watched(
                part.OTHER_PLACES, argument_functions._in_other_places, _any_found
            ),
        },
        answer: {
            "least_determined": watched(
                part.STRENGTHS, answer.least_determined, lambda worst, *_: worst is not None
            )
        },
        screen: {"rank_places": watched(part.PLACES_FIRST, rank_places, _any_found)},
        search: {
            "MOVES": [_watched_move(notes, move) for move in moves.MOVES],
            "choose": notes.chosen,
            "drop": watched(part.DROP, moves.drop, lambda left, _, begun, given: left is not given),
            "release_widths": widths,
            "curve_instead": _watched_by(
                notes,
                (part.CURVE_INSTEAD, part.FREE_CURVE, part.FREE_DYNAMICS),
                argument_functions.curve_instead,
                lambda end, *_: end is not None,
            ),
            "answers": watched(part.ANSWER, answer.answers, _replaced),
        },
    }


def _watched_move(notes: PartNotes, move: moves.Move) -> moves.Move:
    """Watch moves of last resort, and `ADD_TWO`; the move `ADD` always counts.

    Refused pairs have an influence only if `EXCLUDE` can use them.
    """
    if move.part is LoopPart.ADD:
        return move
    propose = notes.watched(move.part, move.propose, lambda *_: False)
    preferred = notes.watched(
        move.part, move.preferred, _wins if move.part in LAST_RESORT else _wins_or_is_used
    )
    return replace(move, propose=propose, preferred=preferred)


def _wins(_: RoundEnd, _begun: RoundStart, _best: RoundEnd, own: RoundEnd) -> bool:
    return own.won is not None


def _wins_or_is_used(kept: RoundEnd, begun: RoundStart, best: RoundEnd, own: RoundEnd) -> bool:
    return kept is own or (best.won is None and bool(begun.model.added))


def _replaced(ends: Sequence[SelectionResult], _: Fitter, grown: SelectionResult) -> bool:
    """Return whether the answer is not the last structure, or may be replaced later."""
    return len(ends) > 1 or ends[0].current is not grown.current


def _watched_by(notes: PartNotes, parts: Sequence[LoopPart], call: Calls, changes: Calls) -> Calls:
    """Watch a function that belongs to several parts."""
    for part in parts:
        call = notes.watched(part, call, changes)
    return call


def _any_found(found: Sequence[object], *_: object) -> bool:
    return bool(found)


def _said(answer: bool, *_: object) -> bool:
    return answer


def _left_out(left: list[Any], _fitter: object, _current: object, contenders: list[Any]) -> bool:
    """Return whether a filter has removed or moved anything."""
    return list(map(id, left)) != list(map(id, contenders))
