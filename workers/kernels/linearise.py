"""Simulating a model and, at every time of the grid, its derivatives by central differences.

With effects, the differences are those of the FMU together with its effects. An input is then
changed behind all of them, through coefficients of their own at the end of the chain ("knobs"), so
that an effect at a derivative that depends on an input sees the change as well.

The FMU is put back to where it stood after each time, so that the trajectory keeps its bits.
"""

from __future__ import annotations

from typing import NamedTuple

from workers.kernels.fmi.calling import inlined, kernel
from workers.kernels.fmi.failure import EVENT, FINISHED, OUTPUT, failed
from workers.kernels.fmi.hooks import take_point
from workers.kernels.fmi.values import DISCARD, get_values, set_reals
from workers.kernels.model_exchange.moving import go_to, record_outputs, slopes_here
from workers.kernels.model_exchange.solver_steps import arrive, start
from workers.kernels.solvers.dormand_prince import adaptive_steps
from workers.kernels.solvers.rk4 import equal_steps
from workers.messages import FloatArray, IntArray

ADAPTIVE, FIXED, GIVEN = range(3)
"""Ways to go from each time of the grid to the next."""

LINEARISATION = 9
"""A code beside those of `workers.kernels.fmi.failure`."""

SENTENCES = {LINEARISATION: "the FMU could not answer close to its trajectory"}

RELATIVE_STEP = 1e-5
"""Near the cube root of the rounding unit: there, rounding and curvature cost a central difference
equally little, some 1e-10 of the derivative."""


class PerturbationRange(NamedTuple):
    """Of each variable that is changed: its usual size, and the bounds that the FMU declares."""

    nominals: FloatArray
    lows: FloatArray
    highs: FloatArray


class PerturbedVariables(NamedTuple):
    """What is changed for the differences.

    `references` are those of the tunable parameters, `values` their values in this simulation, and
    `varied` where each stands among the parameters that effects vary, or -1. `knobs` is where the
    coefficients that are added to the inputs begin; they are there if there is a hook `before`.
    """

    states: PerturbationRange
    inputs: PerturbationRange
    parameters: PerturbationRange
    references: IntArray
    values: FloatArray
    varied: IntArray
    knobs: int


class LinearisationArrays(NamedTuple):
    """What is filled in: a row for each time, and memory for the two ends of a difference."""

    states: FloatArray
    slopes: FloatArray
    edited: FloatArray
    slopes_by_state: FloatArray
    slopes_by_input: FloatArray
    slopes_by_parameter: FloatArray
    outputs_by_state: FloatArray
    outputs_by_input: FloatArray
    outputs_by_parameter: FloatArray
    upper_slopes: FloatArray
    lower_slopes: FloatArray
    upper_outputs: FloatArray
    lower_outputs: FloatArray
    value: FloatArray


@kernel
def linearise(  # type: ignore[no-untyped-def]
    way, c, references, starts, settings, hooks, probing, grid, point, work,
    probe, found, record,
):  # fmt: skip
    """Simulate one experiment for one point, and linearise the model at each time of the grid.

    Parameters
    ----------
    way
        How to go from each time to the next: by the Dormand-Prince method (ADAPTIVE), by classic
        Runge-Kutta (FIXED), or to the states that `found` has already (GIVEN).
    hooks, probing
        Effects, and the same with a knob at each input.
    point : (k,)
        Start values of the reals.
    probe, found
        What is changed, and what is filled in.
    record : (n, y)
        Filled with the outputs.

    Returns
    -------
    (code, time)
        0, or what went wrong, and the time of it.
    """
    times, steps_left = grid.times, settings.max_steps
    time, proposed = times[0], 0.0
    take_point(hooks, 0, work)
    code = start(c, references, starts, settings, hooks, grid, point, work)
    for i in range(len(times)):
        if code == FINISHED:
            code = arrive(c, references, settings, hooks, grid, i, time, work)
        if code != FINISHED:
            return code, time
        status = record_outputs(c, references, hooks, grid, i, time, work, record[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), time
        status = _linearise_here(c, references, hooks, probing, grid, i, work, probe, found)
        if status >= DISCARD:
            return failed(LINEARISATION, status), time
        if i + 1 == len(times):
            break
        code, time, proposed, steps_left = _go_on(
            way, c, references, settings, hooks, grid, i, time, proposed, steps_left, work, found
        )
    return code, time


@inlined
def _go_on(way, c, references, settings, hooks, grid, i, time, proposed, steps_left, work, found):  # type: ignore[no-untyped-def]
    """To grid time i + 1. Returns what `adaptive_steps` does."""
    code = FINISHED
    if way == ADAPTIVE:
        code, time, proposed, steps_left = adaptive_steps(
            c, references, settings, hooks, grid, i, time, proposed, steps_left, work
        )
    elif way == FIXED:
        code, time, steps_left = equal_steps(
            c, references, settings, hooks, grid, i, time, steps_left, work
        )
    else:
        time = grid.times[i + 1]
        if work.next_event[0] <= time:
            code = EVENT
        for j in range(len(work.states)):
            work.states[j] = found.states[i + 1, j]
    return code, time, proposed, steps_left


@kernel
def _linearise_here(c, references, hooks, probing, grid, i, work, probe, found):  # type: ignore[no-untyped-def]
    """All derivatives at grid time i, where the FMU stands before and after. Gives the status."""
    time, x = grid.times[i], work.states
    status = slopes_here(c, hooks, time, x, work, found.slopes[i])
    for j in range(len(x)):
        found.states[i, j] = x[j]
    for j in range(len(probe.inputs.nominals)):  # measured signals may follow them in `work`
        found.edited[i, j] = work.edited[j] if hooks.before != 0 else work.inputs[j]
    if status < DISCARD:
        status = max(status, _by_states(c, references, probing, time, i, work, probe, found))
    if status < DISCARD:
        status = max(status, _by_inputs(c, references, probing, time, i, work, probe, found))
    if status < DISCARD:
        status = max(status, go_to(c, references, hooks, time, x, work))
    if status < DISCARD:
        status = max(status, _by_parameters(c, references, hooks, time, i, work, probe, found))
    if status < DISCARD:  # the parameters that effects vary, too
        status = max(status, go_to(c, references, hooks, time, x, work))
    return status


@kernel
def _by_states(c, references, hooks, time, i, work, probe, found):  # type: ignore[no-untyped-def]
    x, trial = work.states, work.trial
    status = 0
    for j in range(len(x)):
        trial[j] = x[j]
    for j in range(len(x)):
        upper, lower = _ends(x[j], probe.states.nominals[j], probe.states, j)
        trial[j] = upper
        status = max(status, _ask(c, references, hooks, time, trial, work, found, True))
        trial[j] = lower
        if status < DISCARD:
            status = max(status, _ask(c, references, hooks, time, trial, work, found, False))
        trial[j] = x[j]
        if status >= DISCARD:
            return status
        _divide(upper - lower, found, found.slopes_by_state[i], found.outputs_by_state[i], j)
    return status


@kernel
def _by_inputs(c, references, hooks, time, i, work, probe, found):  # type: ignore[no-untyped-def]
    x, status = work.states, 0
    for j in range(len(probe.inputs.nominals)):
        u = found.edited[i, j]
        upper, lower = _ends(u, probe.inputs.nominals[j], probe.inputs, j)
        _turn(hooks, work, probe, j, u, upper)
        status = max(status, _ask(c, references, hooks, time, x, work, found, True))
        _turn(hooks, work, probe, j, u, lower)
        if status < DISCARD:
            status = max(status, _ask(c, references, hooks, time, x, work, found, False))
        _turn(hooks, work, probe, j, u, u)
        if status >= DISCARD:
            return status
        _divide(upper - lower, found, found.slopes_by_input[i], found.outputs_by_input[i], j)
    return status


@inlined
def _turn(hooks, work, probe, j, u, value):  # type: ignore[no-untyped-def]
    """Let an input that would reach the FMU as `u` reach it as another value."""
    if hooks.before != 0:
        work.coefficients[probe.knobs + j] = value - u
    else:
        work.inputs[j] = value


@kernel
def _by_parameters(c, references, hooks, time, i, work, probe, found):  # type: ignore[no-untyped-def]
    """From where the FMU stands; each parameter is put back."""
    x, status = work.states, 0
    for j in range(len(probe.references)):
        reference = probe.references[j : j + 1]
        p = work.varied[probe.varied[j]] if probe.varied[j] >= 0 else probe.values[j]
        size = abs(p) if p != 0.0 else probe.parameters.nominals[j]
        upper, lower = _ends(p, size, probe.parameters, j)
        found.value[0] = upper
        status = max(status, set_reals(c, reference, found.value))
        if status < DISCARD:
            status = max(status, _answer(c, references, hooks, time, x, work, found, True))
        found.value[0] = lower
        if status < DISCARD:
            status = max(status, set_reals(c, reference, found.value))
        if status < DISCARD:
            status = max(status, _answer(c, references, hooks, time, x, work, found, False))
        found.value[0] = p
        if status < DISCARD:
            status = max(status, set_reals(c, reference, found.value))
        if status >= DISCARD:
            return status
        _divide(
            upper - lower, found, found.slopes_by_parameter[i], found.outputs_by_parameter[i], j
        )
    return status


@inlined
def _ends(value, nominal, within, j):  # type: ignore[no-untyped-def]
    """The two ends of a difference: a bound that the FMU declares is not crossed."""
    step = RELATIVE_STEP * max(abs(value), nominal)
    upper = min(value + step, max(within.highs[j], value))
    lower = max(value - step, min(within.lows[j], value))
    if upper > lower:
        return upper, lower
    return value + step, value - step


@kernel
def _ask(c, references, hooks, time, states, work, found, upper):  # type: ignore[no-untyped-def]
    """Move the FMU and ask for slopes and outputs, at one end of a difference."""
    status = go_to(c, references, hooks, time, states, work)
    if status >= DISCARD:
        return status
    return max(status, _answer(c, references, hooks, time, states, work, found, upper))


@kernel
def _answer(c, references, hooks, time, states, work, found, upper):  # type: ignore[no-untyped-def]
    slopes = found.upper_slopes if upper else found.lower_slopes
    outputs = found.upper_outputs if upper else found.lower_outputs
    status = slopes_here(c, hooks, time, states, work, slopes)
    return (
        max(status, get_values(c, references.outputs, outputs, work.cell))
        if status < DISCARD
        else status
    )


@inlined
def _divide(width, found, slopes, outputs, j):  # type: ignore[no-untyped-def]
    """Fill column j of two matrices."""
    for r in range(len(found.upper_slopes)):
        slopes[r, j] = (found.upper_slopes[r] - found.lower_slopes[r]) / width
    for r in range(len(found.upper_outputs)):
        outputs[r, j] = (found.upper_outputs[r] - found.lower_outputs[r]) / width
