"""One simulation with forward sensitivities of its outputs, on the steps of the solver."""

from __future__ import annotations

from workers.kernels.fmi.compiling import kernel, subroutine
from workers.kernels.fmi.failure import FINISHED, HAS_EVENTS, OUTPUT, SENSITIVITIES, failed
from workers.kernels.fmi.functions import get_directional_derivative
from workers.kernels.fmi.progress import count_simulation
from workers.kernels.fmi.reference import by_reference
from workers.kernels.fmi.values import DISCARD
from workers.kernels.model_exchange.evaluation import record_outputs
from workers.kernels.model_exchange.forward_sensitivities import instance_of, record_sensitivities
from workers.kernels.model_exchange.solver_steps import start_simulation
from workers.kernels.solvers.dormand_prince import adaptive_steps
from workers.kernels.solvers.rk4 import equal_steps


@kernel
def simulate_forward(  # type: ignore[no-untyped-def]
    fixed, c, references, starts, settings, hooks, grid, point, work, forward, outputs
):
    """Simulate one experiment for one point, with sensitivities, without events.

    Parameters
    ----------
    fixed
        True for classic Runge-Kutta with a fixed step, None for the Dormand-Prince method: only
        the one that is used is compiled.
    outputs : (n, y)
        Filled with the outputs; `sensitivities` with their sensitivities.

    Returns
    -------
    (code, time)
        0, or what went wrong, and the time of it.
    """
    c, references, starts, settings, hooks, grid, work, forward = by_reference(
        (c, references, starts, settings, hooks, grid, work, forward)
    )
    times, most = grid.times, settings.max_steps
    time, proposed = times[0], 0.0
    count_simulation(work)
    code = _start_sensitivities(c, references, starts, settings, hooks, grid, point, work, forward)
    if code == FINISHED:
        code = _start_compiled_once(c, references, starts, settings, hooks, grid, point, work)
    for i in range(len(times)):
        if code != FINISHED:
            return code, time
        if work.next_event[0] <= times[-1]:
            return HAS_EVENTS, time
        status = record_outputs(c, references, hooks, grid, i, time, work, outputs[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), time
        status = record_sensitivities(c, references, hooks, grid, i, work, forward)
        if status >= DISCARD:
            return failed(SENSITIVITIES, status), time
        if i + 1 == len(times):
            return code, time
        if fixed is not None:
            code, time, _ = equal_steps(
                c, references, settings, hooks, grid, i, time, most, work, forward
            )
        else:
            code, time, proposed, _ = adaptive_steps(
                c, references, settings, hooks, grid, i, time, proposed, most, work, forward
            )
    return code, time


@subroutine
def _start_compiled_once(c, references, starts, settings, hooks, grid, point, work):  # type: ignore[no-untyped-def]
    """Start a simulation; one compiled function for all callers here, which compiles faster."""
    return start_simulation(c, references, starts, settings, hooks, grid, point, work)


@subroutine
def _start_sensitivities(c, references, starts, settings, hooks, grid, point, work, forward):  # type: ignore[no-untyped-def]
    """Compute S(t0) by differences of initial states; perturbed instances are initialised too."""
    for p in range(len(forward.kinds)):
        for side in range(2):
            for j in range(len(point)):
                forward.point[j] = point[j]
            forward.point[forward.positions[p]] = forward.values[p, side]
            code = _start_compiled_once(
                instance_of(c, forward.handles[p, side]),
                references, starts, settings, hooks, grid, forward.point, work,
            )  # fmt: skip
            if code != FINISHED:
                return code
            for j in range(len(work.states)):
                forward.perturbed_results[side, j] = work.states[j]
        width = forward.values[p, 0] - forward.values[p, 1]
        for j in range(len(work.states)):
            forward.current[p, j] = (
                forward.perturbed_results[0, j] - forward.perturbed_results[1, j]
            ) / width
    return FINISHED


@kernel
def is_known(  # type: ignore[no-untyped-def]
    c, references, starts, settings, hooks, grid, point, work, unknowns, known, derivatives
):
    """Start the FMU and get a derivative by one variable. Returns (code, status)."""
    c, references, starts, settings, hooks, grid, work = by_reference(
        (c, references, starts, settings, hooks, grid, work)
    )
    code = _start_compiled_once(c, references, starts, settings, hooks, grid, point, work)
    if code != FINISHED:
        return code, 0
    derivatives[len(unknowns)] = 1.0
    return code, get_directional_derivative(
        c, unknowns, known, 1, derivatives[len(unknowns) :], derivatives
    )
