"""Tasks of workers, and their limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

from workers.messages.equality import by_content
from workers.messages.model import Effect
from workers.messages.types import FloatArray, Want


@by_content
@dataclass(frozen=True, slots=True)
class Task:
    """One point and one experiment: the unit of distribution.

    Attributes
    ----------
    id
        Chosen by the coordinator; the outcome repeats it.
    experiment
        Index of the experiment among those that the worker has.
    values
        Physical values of `Model.parameters`, then of the coefficients of each effect.
    want
        "residuals"; "squares" or "absolutes" for one number in place of those of each output (not
        with a cost function), see `REDUCTIONS`; "trajectory" for the outputs at every time of the
        simulation's grid too; "linearisation" for the model's derivatives there (model exchange
        only); or "sensitivities" for the derivatives of the residuals by the parameters, where the
        model can give them.
    effects
        What is added to the model.
    bound
        Sum of squared residuals above which nobody needs to know more: the simulation may end as
        soon as its sum so far is above it, with `Status.ENDED_EARLY`. It does where all residuals
        are those of plain outputs and no effects act; elsewhere it goes to its end.
    """

    id: int
    experiment: int
    values: FloatArray
    want: Want = "residuals"
    effects: tuple[Effect, ...] = ()
    bound: float = math.inf


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits beyond which a simulation in a process of its own is ended from outside.

    Attributes
    ----------
    seconds
        Longest that one simulation may take on the wall's clock.
    stall
        Seconds for which it may stand still: no step ends, though the system lets it run, or it
        sleeps. It has to happen twice.
    memory
        Most bytes that the process may have in memory.
    growth
        Bytes by which it may grow over many simulations before it is replaced by a fresh one.
    """

    seconds: float = 600.0
    stall: float = 60.0
    memory: float = float("inf")
    growth: float = 256.0 * 2**20
