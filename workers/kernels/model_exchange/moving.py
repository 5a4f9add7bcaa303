"""Telling an FMU in model exchange where it is, and asking it for slopes and outputs there."""

from __future__ import annotations

from workers.kernels.fmi.calling import inlined, kernel
from workers.kernels.fmi.functions import get_derivatives, set_continuous_states, set_time
from workers.kernels.fmi.hooks import before, inside, take_inputs
from workers.kernels.fmi.progress import count_call
from workers.kernels.fmi.values import DISCARD, get_values, set_reals, set_values


@inlined
def go_to(c, references, hooks, time, states, work):  # type: ignore[no-untyped-def]
    """Tell the FMU where it is; its inputs are in `work`. Returns the worst status."""
    count_call(work)
    status = set_time(c, time)
    if status < DISCARD and c.n_states > 0:
        status = max(status, set_continuous_states(c, states))
    if hooks.before != 0:
        before(hooks, time, states, work)
        if status < DISCARD:
            status = max(status, set_values(c, references.moving, work.edited, work.cell))
        if status < DISCARD and len(work.varied) > 0:
            status = max(status, set_reals(c, hooks.parameters, work.varied))
    elif status < DISCARD:
        status = max(status, set_values(c, references.moving, work.inputs, work.cell))
    return status


@kernel
def stand(c, references, hooks, grid, i, time, states, work):  # type: ignore[no-untyped-def]
    """Move the FMU to some states, at a time after grid time i. Returns the worst status.

    For what happens rarely: it is compiled once, and a call of it costs more than what it does.
    """
    take_inputs(grid, i, time, work)
    return go_to(c, references, hooks, time, states, work)


@inlined
def slopes_here(c, hooks, time, states, work, result):  # type: ignore[no-untyped-def]
    """dx/dt where the FMU stands. Returns the status."""
    status = get_derivatives(c, result) if c.n_states > 0 else 0
    inside(hooks, time, states, work, result)
    return status


@inlined
def derivative(c, references, hooks, grid, i, time, states, work, result):  # type: ignore[no-untyped-def]
    """dx/dt at a time in the interval after grid time i. Returns the worst status."""
    take_inputs(grid, i, time, work)
    status = go_to(c, references, hooks, time, states, work)
    if status >= DISCARD:
        return status
    return max(status, slopes_here(c, hooks, time, states, work, result))


@inlined
def record_outputs(c, references, hooks, grid, i, time, work, record):  # type: ignore[no-untyped-def]
    """The outputs at grid time i, to which the FMU is moved. Returns the worst status.

    `time` is that of the grid, or later by a rounding error where an event is.
    """
    take_inputs(grid, i, grid.times[i], work)
    status = go_to(c, references, hooks, time, work.states, work)
    if status < DISCARD:
        status = max(status, get_values(c, references.outputs, record, work.cell))
    return status
