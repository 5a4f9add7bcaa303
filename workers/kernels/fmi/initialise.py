"""Initialisation of an instance for a simulation, in the order of the FMI standard."""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

from workers.kernels.fmi.compiling import inlined
from workers.kernels.fmi.functions import (
    enter_configuration_mode,
    enter_initialization_mode,
    exit_configuration_mode,
    exit_initialization_mode,
    reset,
    set_strings,
    setup_experiment,
)
from workers.kernels.fmi.values import DISCARD, set_values
from workers.messages import FloatArray


class SolverSettings(NamedTuple):
    """A `workers.messages.Solver` for compiled code: 0 stands for "not given".

    `atols` holds the absolute tolerance of each state: `atol` times its nominal value. `fixed` is
    the communication step of an FMU that takes no other; `step` has room for rounding then.
    """

    step: float
    rtol: float
    atol: float
    atols: FloatArray
    max_steps: int
    fmu_tolerance: float
    fixed: float = 0.0


@inlined
def n_steps(length, longest, limit):  # type: ignore[no-untyped-def]
    """Return the number of equal steps of an interval; more than `limit` is `limit` + 1."""
    if longest <= 0.0:
        return 1
    needed = length / longest - 1e-9
    return max(1, ceil(needed)) if needed < limit else limit + 1


@inlined
def initialise(c, references, starts, values, inputs, tolerance, start, work):  # type: ignore[no-untyped-def]
    """Reset, write every start value, initialise. Returns the worst status.

    Everything is written after each reset, because some FMUs do not reset their parameters. After a
    failure nothing more is called: the standard forbids it.
    """
    status = reset(c)
    if status < DISCARD and len(starts.structure.elements) > 0:
        status = max(status, _configure(c, starts.structure, values, work))
    if status < DISCARD:  # before the values, like most importers: some FMUs set defaults in it
        status = max(status, setup_experiment(c, tolerance, start, starts.stop))
    if status < DISCARD:
        status = max(status, set_values(c, starts.numbers, values, work.buffer))
    if status < DISCARD and len(starts.strings) > 0:
        status = max(status, set_strings(c, starts.strings, starts.texts))
    if status < DISCARD:
        status = max(status, enter_initialization_mode(c, tolerance, start, starts.stop))
    if status < DISCARD:
        status = max(status, set_values(c, references.inputs, inputs, work.buffer))
    if status < DISCARD:
        status = max(status, exit_initialization_mode(c))
    return status


@inlined
def _configure(c, structure, values, work):  # type: ignore[no-untyped-def]
    """Set structural parameters, which say how large arrays are."""
    status = enter_configuration_mode(c)
    if status < DISCARD:
        status = max(status, set_values(c, structure, values, work.buffer))
    if status < DISCARD:
        status = max(status, exit_configuration_mode(c))
    return status
