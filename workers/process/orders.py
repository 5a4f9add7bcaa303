"""What a program, its template, the fork servers and their processes say to each other.

Whoever only asks imports this alone: an evaluator, and what compiles its loops, stays in the
processes that simulate.
"""

from __future__ import annotations

from dataclasses import dataclass

from workers.messages import Experiment, Model
from workers.wire import OutcomeColumns

FORK, FORK_FOR_EFFECTS, END = "fork", "fork for effects", "end"
"""What a fork server is told."""

Installation = tuple[Model, tuple[Experiment, ...], str]
"""The model, the experiments and the worker's name: what an `Evaluator` is made of."""


@dataclass(frozen=True)
class StartOrder:
    """A fork server that is wanted. Three handles follow: orders, progress, standard error.

    Attributes
    ----------
    installation
        What its processes make their evaluators of.
    environment, folder
        What the program has now: its environment variables, and the folder that it works in.
    """

    installation: Installation
    environment: dict[str, str]
    folder: str


@dataclass(frozen=True)
class BatchReport:
    """Answers to a batch, and what the process has come to.

    Attributes
    ----------
    answers
        In the order of the batch.
    resident, instances
        Bytes in memory, and FMU instances that it has made.
    spent
        Whether it can make no instance any more, which may have failed tasks after the first.
    """

    answers: OutcomeColumns
    resident: int
    instances: int
    spent: bool = False
