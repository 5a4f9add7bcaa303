"""One simulation with the sensitivities of its outputs, carried along by the solver's own steps."""

from __future__ import annotations

from workers.kernels.fmi.calling import kernel
from workers.kernels.fmi.failure import FINISHED, HAS_EVENTS, OUTPUT, SENSITIVITIES, failed
from workers.kernels.fmi.functions import get_directional_derivative
from workers.kernels.fmi.progress import count_simulation
from workers.kernels.fmi.values import DISCARD
from workers.kernels.model_exchange.forward_sensitivities import instance_of, record_sensitivities
from workers.kernels.model_exchange.moving import record_outputs
from workers.kernels.model_exchange.solver_steps import start
from workers.kernels.solvers.dormand_prince import adaptive_steps
from workers.kernels.solvers.rk4 import equal_steps


@kernel
def simulate_forward(  # type: ignore[no-untyped-def]
    fixed, c, references, starts, settings, hooks, grid, point, work, forward, record
):
    """Simulate one experiment for one point, with sensitivities, without events.

    Parameters
    ----------
    fixed
        True for classic Runge-Kutta with a fixed step, None for the Dormand-Prince method: only
        the one that is used is compiled.
    record : (n, y)
        Filled with the outputs; `forward.record` with their sensitivities.

    Returns
    -------
    (code, time)
        0, or what went wrong, and the time of it.
    """
    times, steps_left = grid.times, settings.max_steps
    time, proposed = times[0], 0.0
    count_simulation(work)
    code = _start_sensitivities(c, references, starts, settings, hooks, grid, point, work, forward)
    if code == FINISHED:
        code = _start(c, references, starts, settings, hooks, grid, point, work)
    for i in range(len(times)):
        if code != FINISHED:
            return code, time
        if work.next_event[0] <= times[-1]:
            return HAS_EVENTS, time
        status = record_outputs(c, references, hooks, grid, i, time, work, record[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), time
        status = record_sensitivities(c, references, hooks, grid, i, work, forward)
        if status >= DISCARD:
            return failed(SENSITIVITIES, status), time
        if i + 1 == len(times):
            return code, time
        if fixed is not None:
            code, time, steps_left = equal_steps(
                c, references, settings, hooks, grid, i, time, steps_left, work, forward
            )
        else:
            code, time, proposed, steps_left = adaptive_steps(
                c, references, settings, hooks, grid, i, time, proposed, steps_left, work, forward
            )
    return code, time


@kernel
def _start(c, references, starts, settings, hooks, grid, point, work):  # type: ignore[no-untyped-def]
    """Compiled once, for all who start an instance here."""
    return start(c, references, starts, settings, hooks, grid, point, work)


@kernel
def _start_sensitivities(c, references, starts, settings, hooks, grid, point, work, forward):  # type: ignore[no-untyped-def]
    """S(t0) by differences of the initial states; leaves the twins where the simulation starts."""
    for p in range(len(forward.kinds)):
        for side in range(2):
            for j in range(len(point)):
                forward.point[j] = point[j]
            forward.point[forward.columns[p]] = forward.values[p, side]
            code = _start(
                instance_of(c, forward.handles[p, side]),
                references, starts, settings, hooks, grid, forward.point, work,
            )  # fmt: skip
            if code != FINISHED:
                return code
            for j in range(len(work.states)):
                forward.sides[side, j] = work.states[j]
        width = forward.values[p, 0] - forward.values[p, 1]
        for j in range(len(work.states)):
            forward.columns_now[p, j] = (forward.sides[0, j] - forward.sides[1, j]) / width
    return FINISHED


@kernel
def takes_as_known(  # type: ignore[no-untyped-def]
    c, references, starts, settings, hooks, grid, point, work, unknowns, known, found
):
    """Start the FMU and ask it for a derivative by one variable. Returns (code, status)."""
    code = _start(c, references, starts, settings, hooks, grid, point, work)
    if code != FINISHED:
        return code, 0
    found[len(unknowns)] = 1.0
    return code, get_directional_derivative(c, unknowns, known, 1, found[len(unknowns) :], found)
