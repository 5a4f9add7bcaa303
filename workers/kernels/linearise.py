"""Simulate a model and, at every time of the grid, its derivatives by central differences.

With effects, the differences are those of the FMU together with its effects. An input is then
perturbed behind all of them, by an offset that is added at the end of the chain of effects, so
that an effect at a derivative that depends on an input sees the change as well.

States, inputs and parameters of the FMU are restored after each time, so that the trajectory keeps
its bits.
"""

from __future__ import annotations

from typing import NamedTuple

from workers.kernels.fmi.compiling import inlined, kernel, subroutine
from workers.kernels.fmi.failure import EVENT, FINISHED, OUTPUT, failed
from workers.kernels.fmi.hooks import select_point
from workers.kernels.fmi.reference import by_reference
from workers.kernels.fmi.values import DISCARD, get_values, set_reals
from workers.kernels.model_exchange.evaluation import (
    current_derivatives,
    record_outputs,
    set_time_and_states,
)
from workers.kernels.model_exchange.solver_steps import handle_input_jump, start_simulation
from workers.kernels.solvers.dormand_prince import adaptive_steps
from workers.kernels.solvers.rk4 import equal_steps
from workers.messages import FloatArray, IntArray

ADAPTIVE, FIXED, PRECOMPUTED = range(3)
"""Ways of stepping from each time of the grid to the next."""
LINEARISATION = 9
"""A code beside those of `workers.kernels.fmi.failure`."""
MESSAGES = {LINEARISATION: "the FMU could not answer close to its trajectory"}
RELATIVE_STEP = 1e-5
"""Near the cube root of the rounding unit: there, rounding and curvature cost a central difference
equally little, some 1e-10 of the derivative."""


class PerturbationRange(NamedTuple):
    """Nominal values of perturbed variables, and the bounds that the FMU declares."""

    nominals: FloatArray
    lows: FloatArray
    highs: FloatArray


class PerturbedVariables(NamedTuple):
    """Variables that are perturbed for the differences.

    `references` are those of the tunable parameters, `values` their values in this simulation, and
    `effect_positions` the position of each among the parameters that effects change, or -1.
    `input_offsets` is the position of the first of the coefficients that are added to the inputs;
    they exist where there is a hook `modify_inputs`.
    """

    states: PerturbationRange
    inputs: PerturbationRange
    parameters: PerturbationRange
    references: IntArray
    values: FloatArray
    effect_positions: IntArray
    input_offsets: int


class LinearisationArrays(NamedTuple):
    """Results, a row for each time, and memory for the two ends of a difference.

    A, B, C, D, P and Q are those of `workers.messages.Linearisation`.
    """

    states: FloatArray
    derivatives: FloatArray
    effective_inputs: FloatArray
    A: FloatArray
    B: FloatArray
    P: FloatArray
    C: FloatArray
    D: FloatArray
    Q: FloatArray
    upper_derivatives: FloatArray
    lower_derivatives: FloatArray
    upper_outputs: FloatArray
    lower_outputs: FloatArray
    value: FloatArray


@kernel
def linearise(  # type: ignore[no-untyped-def]
    stepping, c, references, starts, settings, hooks, offsets, grid, point, work,
    perturbed, result, outputs,
):  # fmt: skip
    """Simulate one experiment for one point, and linearise the model at each time of the grid.

    Parameters
    ----------
    stepping
        From each time to the next by the Dormand-Prince method (ADAPTIVE), by classic Runge-Kutta
        (FIXED), or to the states that `result` has already (PRECOMPUTED).
    hooks, offsets
        Effects, and the same with an offset at each input.
    point : (k,)
        Start values of the reals.
    perturbed, result
        Variables to perturb; filled with the derivatives.
    outputs : (n, y)
        Filled with the outputs.

    Returns
    -------
    (code, time)
        0, or what went wrong, and the time of it.
    """
    c, references, starts, settings, hooks, offsets, grid, work = by_reference(
        (c, references, starts, settings, hooks, offsets, grid, work)
    )
    perturbed, result = by_reference((perturbed, result))
    times, most = grid.times, settings.max_steps
    time, proposed = times[0], 0.0
    select_point(hooks, 0, work)
    code = start_simulation(c, references, starts, settings, hooks, grid, point, work)
    for i in range(len(times)):
        if code == FINISHED:
            code = handle_input_jump(c, references, settings, hooks, grid, i, time, work)
        if code != FINISHED:
            return code, time
        status = record_outputs(c, references, hooks, grid, i, time, work, outputs[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), time
        status = linearise_at(c, references, hooks, offsets, grid, i, work, perturbed, result)
        if status >= DISCARD:
            return failed(LINEARISATION, status), time
        if i + 1 == len(times):
            break
        code, time, proposed, _ = step_on_grid(
            stepping, c, references, settings, hooks, grid, i, time, proposed, most, work, result,
        )  # fmt: skip
    return code, time


@inlined
def step_on_grid(  # type: ignore[no-untyped-def]
    stepping, c, references, settings, hooks, grid, i, time, proposed, steps_left, work, result
):
    """Step to grid time i + 1. Returns what `adaptive_steps` does."""
    code = FINISHED
    if stepping == ADAPTIVE:
        code, time, proposed, steps_left = adaptive_steps(
            c, references, settings, hooks, grid, i, time, proposed, steps_left, work
        )
    elif stepping == FIXED:
        code, time, steps_left = equal_steps(
            c, references, settings, hooks, grid, i, time, steps_left, work
        )
    else:
        time = grid.times[i + 1]
        if work.next_event[0] <= time:
            code = EVENT
        for j in range(len(work.states)):
            work.states[j] = result.states[i + 1, j]
    return code, time, proposed, steps_left


@subroutine
def linearise_at(c, references, hooks, offsets, grid, i, work, perturbed, result):  # type: ignore[no-untyped-def]
    """Take all derivatives at grid time i, which the FMU is set to. Returns the worst status."""
    time, x = grid.times[i], work.states
    status = current_derivatives(c, hooks, time, x, work, result.derivatives[i])
    for j in range(len(x)):
        result.states[i, j] = x[j]
    for j in range(len(perturbed.inputs.nominals)):  # measured signals may follow them in `work`
        result.effective_inputs[i, j] = (
            work.effective_inputs[j] if hooks.modify_inputs != 0 else work.inputs[j]
        )
    if status < DISCARD:
        status = max(status, _by_states(c, references, offsets, time, i, work, perturbed, result))
    if status < DISCARD:
        status = max(status, _by_inputs(c, references, offsets, time, i, work, perturbed, result))
    if status < DISCARD:
        status = max(status, set_time_and_states(c, references, hooks, time, x, work))
    if status < DISCARD:
        status = max(status, _by_parameters(c, references, hooks, time, i, work, perturbed, result))
    if status < DISCARD:  # and the parameters that effects change
        status = max(status, set_time_and_states(c, references, hooks, time, x, work))
    return status


@subroutine
def _by_states(c, references, hooks, time, i, work, perturbed, result):  # type: ignore[no-untyped-def]
    x, trial = work.states, work.trial
    status = 0
    for j in range(len(x)):
        trial[j] = x[j]
    for j in range(len(x)):
        upper, lower = _perturbed_values(x[j], perturbed.states.nominals[j], perturbed.states, j)
        trial[j] = upper
        status = max(status, _evaluate_at(c, references, hooks, time, trial, work, result, True))
        trial[j] = lower
        if status < DISCARD:
            status = max(
                status, _evaluate_at(c, references, hooks, time, trial, work, result, False)
            )
        trial[j] = x[j]
        if status >= DISCARD:
            return status
        _fill_column(upper - lower, result, result.A[i], result.C[i], j)
    return status


@subroutine
def _by_inputs(c, references, hooks, time, i, work, perturbed, result):  # type: ignore[no-untyped-def]
    x, status = work.states, 0
    for j in range(len(perturbed.inputs.nominals)):
        u = result.effective_inputs[i, j]
        upper, lower = _perturbed_values(u, perturbed.inputs.nominals[j], perturbed.inputs, j)
        _set_input(hooks, work, perturbed, j, u, upper)
        status = max(status, _evaluate_at(c, references, hooks, time, x, work, result, True))
        _set_input(hooks, work, perturbed, j, u, lower)
        if status < DISCARD:
            status = max(status, _evaluate_at(c, references, hooks, time, x, work, result, False))
        _set_input(hooks, work, perturbed, j, u, u)
        if status >= DISCARD:
            return status
        _fill_column(upper - lower, result, result.B[i], result.D[i], j)
    return status


@inlined
def _set_input(hooks, work, perturbed, j, u, value):  # type: ignore[no-untyped-def]
    """Let an input that would reach the FMU as `u` reach it as another value."""
    if hooks.modify_inputs != 0:
        work.coefficients[perturbed.input_offsets + j] = value - u
    else:
        work.inputs[j] = value


@subroutine
def _by_parameters(c, references, hooks, time, i, work, perturbed, result):  # type: ignore[no-untyped-def]
    """Take the derivatives by parameters at the FMU's present states; each is restored."""
    x, status = work.states, 0
    for j in range(len(perturbed.references)):
        reference = perturbed.references[j : j + 1]
        p = (
            work.effective_parameters[perturbed.effect_positions[j]]
            if perturbed.effect_positions[j] >= 0
            else perturbed.values[j]
        )
        size = abs(p) if p != 0.0 else perturbed.parameters.nominals[j]
        upper, lower = _perturbed_values(p, size, perturbed.parameters, j)
        result.value[0] = upper
        status = max(status, set_reals(c, reference, result.value))
        if status < DISCARD:
            status = max(status, _evaluate(c, references, hooks, time, x, work, result, True))
        result.value[0] = lower
        if status < DISCARD:
            status = max(status, set_reals(c, reference, result.value))
        if status < DISCARD:
            status = max(status, _evaluate(c, references, hooks, time, x, work, result, False))
        result.value[0] = p
        if status < DISCARD:
            status = max(status, set_reals(c, reference, result.value))
        if status >= DISCARD:
            return status
        _fill_column(upper - lower, result, result.P[i], result.Q[i], j)
    return status


@inlined
def _perturbed_values(value, nominal, within, j):  # type: ignore[no-untyped-def]
    """Return the two ends of a difference, within the bounds that the FMU declares."""
    step = RELATIVE_STEP * max(abs(value), nominal)
    upper = min(value + step, max(within.highs[j], value))
    lower = max(value - step, min(within.lows[j], value))
    if upper > lower:
        return upper, lower
    return value + step, value - step


@subroutine
def _evaluate_at(c, references, hooks, time, states, work, result, upper):  # type: ignore[no-untyped-def]
    """Set the states and evaluate derivatives and outputs, at one end of a difference."""
    status = set_time_and_states(c, references, hooks, time, states, work)
    if status >= DISCARD:
        return status
    return max(status, _evaluate(c, references, hooks, time, states, work, result, upper))


@subroutine
def _evaluate(c, references, hooks, time, states, work, result, upper):  # type: ignore[no-untyped-def]
    derivatives = result.upper_derivatives if upper else result.lower_derivatives
    outputs = result.upper_outputs if upper else result.lower_outputs
    status = current_derivatives(c, hooks, time, states, work, derivatives)
    return (
        max(status, get_values(c, references.outputs, outputs, work.buffer))
        if status < DISCARD
        else status
    )


@inlined
def _fill_column(width, result, derivatives, outputs, j):  # type: ignore[no-untyped-def]
    """Fill column j of two matrices."""
    for r in range(len(result.upper_derivatives)):
        derivatives[r, j] = (result.upper_derivatives[r] - result.lower_derivatives[r]) / width
    for r in range(len(result.upper_outputs)):
        outputs[r, j] = (result.upper_outputs[r] - result.lower_outputs[r]) / width
