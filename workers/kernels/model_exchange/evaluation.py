"""Set the time, states and inputs of an FMU in model exchange, and get derivatives and outputs."""

from __future__ import annotations

from workers.kernels.fmi.compiling import inlined, subroutine
from workers.kernels.fmi.functions import get_derivatives, set_continuous_states, set_time
from workers.kernels.fmi.hooks import add_derivatives, interpolate_inputs, modify_inputs
from workers.kernels.fmi.progress import note_call
from workers.kernels.fmi.values import DISCARD, get_values, set_reals, set_values


@inlined
def set_time_and_states(c, references, hooks, time, states, work):  # type: ignore[no-untyped-def]
    """Set time, states, and the inputs in `work`. Returns the worst status."""
    note_call(work)
    status = set_time(c, time)
    if status < DISCARD and c.n_states > 0:
        status = max(status, set_continuous_states(c, states))
    if hooks.modify_inputs != 0:
        modify_inputs(hooks, time, states, work)
        if status < DISCARD:
            status = max(
                status,
                set_values(c, references.continuous_inputs, work.effective_inputs, work.buffer),
            )
        if status < DISCARD and len(work.effective_parameters) > 0:
            status = max(status, set_reals(c, hooks.parameters, work.effective_parameters))
    elif status < DISCARD:
        status = max(status, set_values(c, references.continuous_inputs, work.inputs, work.buffer))
    return status


@subroutine
def set_time_inputs_and_states(c, references, hooks, grid, i, time, states, work):  # type: ignore[no-untyped-def]
    """Set time, states and inputs, at a time after grid time i. Returns the worst status.

    For rare events: it is compiled once instead of into each caller, and slower to call.
    """
    interpolate_inputs(grid, i, time, work)
    return set_time_and_states(c, references, hooks, time, states, work)


@inlined
def current_derivatives(c, hooks, time, states, work, derivatives):  # type: ignore[no-untyped-def]
    """Get dx/dt at the present time, states and inputs. Returns the status."""
    status = get_derivatives(c, derivatives) if c.n_states > 0 else 0
    add_derivatives(hooks, time, states, work, derivatives)
    return status


@inlined
def derivatives_at(c, references, hooks, grid, i, time, states, work, derivatives):  # type: ignore[no-untyped-def]
    """Get dx/dt at a time in the interval after grid time i. Returns the worst status."""
    interpolate_inputs(grid, i, time, work)
    status = set_time_and_states(c, references, hooks, time, states, work)
    if status >= DISCARD:
        return status
    return max(status, current_derivatives(c, hooks, time, states, work, derivatives))


@inlined
def record_outputs(c, references, hooks, grid, i, time, work, outputs):  # type: ignore[no-untyped-def]
    """Set the FMU to grid time i and record its outputs. Returns the worst status.

    `time` is that of the grid, or later by a rounding error where an event is.
    """
    interpolate_inputs(grid, i, grid.times[i], work)
    status = set_time_and_states(c, references, hooks, time, work.states, work)
    if status < DISCARD:
        status = max(status, get_values(c, references.outputs, outputs, work.buffer))
    return status
