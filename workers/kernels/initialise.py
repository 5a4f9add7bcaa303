"""From a used instance to the start of a simulation, in the order of the FMI 2.0 standard."""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

from workers.kernels.calling import inlined
from workers.kernels.fmi2 import (
    DISCARD,
    enter_initialization_mode,
    exit_initialization_mode,
    reset,
    set_boolean,
    set_integer,
    set_real,
    setup_experiment,
)
from workers.messages import FloatArray


class Settings(NamedTuple):
    """A `workers.messages.Solver` for compiled code: 0 stands for "not given".

    `atols` holds the absolute tolerance of each state.
    """

    step: float
    rtol: float
    atols: FloatArray
    max_steps: int
    fmu_tolerance: float


@inlined
def n_steps(length, longest, limit):  # type: ignore[no-untyped-def]
    """Into how many equal steps an interval is cut; more than `limit` is `limit` + 1."""
    if longest <= 0.0:
        return 1
    needed = length / longest - 1e-9
    return max(1, ceil(needed)) if needed < limit else limit + 1


@inlined
def initialise(c, references, constants, values, inputs, tolerance, start):  # type: ignore[no-untyped-def]
    """Reset, write every start value, initialise. Returns the worst status.

    Everything is written after each reset, because some FMUs do not reset their parameters. After a
    failure nothing more is called: the standard forbids it.
    """
    worst = reset(c)
    if worst < DISCARD and len(values) > 0:
        worst = max(worst, set_real(c, references.start_reals, values))
    if worst < DISCARD and len(constants.integers) > 0:
        worst = max(worst, set_integer(c, references.start_integers, constants.integers))
    if worst < DISCARD and len(constants.booleans) > 0:
        worst = max(worst, set_boolean(c, references.start_booleans, constants.booleans))
    if worst < DISCARD:
        worst = max(worst, setup_experiment(c, tolerance, start))
    if worst < DISCARD:
        worst = max(worst, enter_initialization_mode(c))
    if worst < DISCARD and len(inputs) > 0:
        worst = max(worst, set_real(c, references.inputs, inputs))
    if worst < DISCARD:
        worst = max(worst, exit_initialization_mode(c))
    return worst
