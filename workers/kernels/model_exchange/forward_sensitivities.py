"""Forward sensitivities S = dx/dtheta, integrated on the steps that the states take.

The states alone control the steps, so the trajectory keeps its bits. After each step its
stages are evaluated once more with

    dS/dt = df/dx S + df/dtheta,    S(t0) = dx0/dtheta

whose right-hand side is one directional derivative of the FMU for each parameter: along a column of
S, and along the parameter too where the FMU takes it as a known. Where it does not, df/dtheta is a
central difference between two further, perturbed instances of the FMU, initialised a little above
and below the value. S is the derivative of the discrete solution for fixed steps.

Reference: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, section
II.6 ("Dependence on initial values and parameters": internal differentiation).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba.core import cgutils, types
from numba.extending import intrinsic

from workers.kernels.fmi.compiling import inlined, subroutine
from workers.kernels.fmi.functions import (
    completed_integrator_step,
    get_derivatives,
    get_directional_derivative,
)
from workers.kernels.fmi.hooks import interpolate_inputs
from workers.kernels.fmi.values import DISCARD, get_reals
from workers.kernels.model_exchange.evaluation import set_time_and_states
from workers.messages import FloatArray, IntArray

INITIAL_STATES, KNOWN, DIFFERENCES = range(3)
"""Kinds of parameters: of initial states alone, knowns of directional derivatives, and those whose
derivatives are differences of perturbed instances."""


class ForwardSensitivities(NamedTuple):
    """Arrays of forward sensitivities: n states, y outputs, p parameters, k values of a point.

    Attributes
    ----------
    kinds, references, positions : (p,)
        Kind of each parameter, its value reference, and its position in a point.
    handles : (p, 2)
        The perturbed instances above and below its value; the simulated one where there are none.
    values : (p, 2)
        Those values.
    derivative_references, output_references : (n,), (a,)
        References of the states' derivatives, and of those outputs that are no states.
    output_positions, output_states : (a,), (y,)
        Position of each of these outputs among all; the state that an output is, or -1.
    knowns, seed : (n + 1,)
        References of the states and room for a parameter's; a direction in them.
    nodes, weights, finals : (s,), (s, s), (s,)
        The Runge-Kutta method: c, a and b.
    current, stages : (p, n), (s, p, n)
        The columns of S, and their derivatives at each stage.
    stage_states, result, perturbed_results, point : (n,), (max(n, a),), (2, max(n, a)), (k,)
        Memory.
    sensitivities : (times, p, y)
        Filled with dy/dtheta.
    """

    kinds: IntArray
    references: IntArray
    positions: IntArray
    handles: IntArray
    values: FloatArray
    derivative_references: IntArray
    output_references: IntArray
    output_positions: IntArray
    output_states: IntArray
    knowns: IntArray
    seed: FloatArray
    nodes: FloatArray
    weights: FloatArray
    finals: FloatArray
    current: FloatArray
    stages: FloatArray
    stage_states: FloatArray
    result: FloatArray
    perturbed_results: FloatArray
    point: FloatArray
    sensitivities: FloatArray


@subroutine
def advance_sensitivities(c, references, hooks, grid, i, time, step, work, forward):  # type: ignore[no-untyped-def]
    """Advance S over a step whose stages are in `work`, before it is accepted. Returns the status.

    The FMU is set to the end of the step and the states in `work.trial` afterwards.
    """
    status = 0
    for stage in range(len(forward.nodes)):
        _stage_states(forward, stage, step, work)
        stage_time = time + forward.nodes[stage] * step
        interpolate_inputs(grid, i, stage_time, work)
        status = max(
            status,
            set_time_and_states(c, references, hooks, stage_time, forward.stage_states, work),
        )
        for p in range(len(forward.kinds)):
            _seed_of_stage(forward, stage, step, p)
            if status < DISCARD:
                status = max(
                    status,
                    _evaluate_derivatives(c, references, hooks, stage_time, work, forward, p),
                )
            for j in range(len(forward.stage_states)):
                forward.stages[stage, p, j] = forward.result[j]
    _sum_stages(forward, step)
    if status < DISCARD:
        status = max(
            status, _return_to_step_end(c, references, hooks, grid, i, time + step, work, forward)
        )
    return status


@inlined
def _stage_states(forward, stage, step, work):  # type: ignore[no-untyped-def]
    """Compute the states of a stage, into `stage_states`."""
    for j in range(len(forward.stage_states)):
        total = 0.0
        for earlier in range(stage):
            total += forward.weights[stage, earlier] * work.stages[earlier, j]
        forward.stage_states[j] = work.states[j] + step * total


@inlined
def _seed_of_stage(forward, stage, step, p):  # type: ignore[no-untyped-def]
    """Compute the column of S of a stage, into `seed`."""
    for j in range(len(forward.stage_states)):
        total = 0.0
        for earlier in range(stage):
            total += forward.weights[stage, earlier] * forward.stages[earlier, p, j]
        forward.seed[j] = forward.current[p, j] + step * total


@inlined
def _sum_stages(forward, step):  # type: ignore[no-untyped-def]
    """Compute S at the end of the step."""
    for p in range(len(forward.kinds)):
        for j in range(len(forward.stage_states)):
            total = 0.0
            for stage in range(len(forward.nodes)):
                total += forward.finals[stage] * forward.stages[stage, p, j]
            forward.current[p, j] += step * total


@inlined
def _return_to_step_end(c, references, hooks, grid, i, time, work, forward):  # type: ignore[no-untyped-def]
    """Set all instances to the end of the step, and complete it on perturbed ones."""
    interpolate_inputs(grid, i, time, work)
    status = set_time_and_states(c, references, hooks, time, work.trial, work)
    if c.completes_steps:
        for p in range(len(forward.kinds)):
            if forward.kinds[p] == DIFFERENCES:
                for side in range(2):
                    perturbed = instance_of(c, forward.handles[p, side])
                    status = max(
                        status,
                        set_time_and_states(perturbed, references, hooks, time, work.trial, work),
                    )
                    if status < DISCARD:
                        status = max(status, completed_integrator_step(perturbed, work.info))
    return status


@subroutine
def _evaluate_derivatives(c, references, hooks, time, work, forward, p):  # type: ignore[no-untyped-def]
    """Compute df/dx s + df/dtheta into `result`, s being `seed`. Returns the worst status."""
    n = len(forward.stage_states)
    status = _directional_derivative(c, forward.derivative_references, forward, p)
    if forward.kinds[p] != DIFFERENCES or n == 0:
        return status
    for side in range(2):
        perturbed = instance_of(c, forward.handles[p, side])
        if status < DISCARD:
            status = max(
                status,
                set_time_and_states(perturbed, references, hooks, time, forward.stage_states, work),
            )
        if status < DISCARD:
            status = max(status, get_derivatives(perturbed, forward.perturbed_results[side]))
    _add_difference(forward, p, n)
    return status


@subroutine
def record_sensitivities(c, references, hooks, grid, i, work, forward):  # type: ignore[no-untyped-def]
    """Record dy/dtheta at grid time i, which the FMU is set to. Returns the worst status."""
    status = 0
    for p in range(len(forward.kinds)):
        for j in range(len(work.states)):
            forward.seed[j] = forward.current[p, j]
            forward.stage_states[j] = work.states[j]
        for output in range(len(forward.output_states)):
            if forward.output_states[output] >= 0:
                forward.sensitivities[i, p, output] = forward.seed[forward.output_states[output]]
        if len(forward.output_references) > 0 and status < DISCARD:
            status = max(status, _directional_derivative(c, forward.output_references, forward, p))
            if forward.kinds[p] == DIFFERENCES:
                status = max(
                    status,
                    _add_output_difference(c, references, hooks, grid.times[i], work, forward, p),
                )
            for output in range(len(forward.output_references)):
                forward.sensitivities[i, p, forward.output_positions[output]] = forward.result[
                    output
                ]
    return status


@inlined
def _add_output_difference(c, references, hooks, time, work, forward, p):  # type: ignore[no-untyped-def]
    """Add dg/dtheta to `result`, from the outputs of perturbed instances."""
    status = 0
    for side in range(2):
        perturbed = instance_of(c, forward.handles[p, side])
        if status < DISCARD:
            status = max(
                status,
                set_time_and_states(perturbed, references, hooks, time, forward.stage_states, work),
            )
        if status < DISCARD:
            status = max(
                status,
                get_reals(perturbed, forward.output_references, forward.perturbed_results[side]),
            )
    _add_difference(forward, p, len(forward.output_references))
    return status


@inlined
def _add_difference(forward, p, count):  # type: ignore[no-untyped-def]
    width = forward.values[p, 0] - forward.values[p, 1]
    for j in range(count):
        forward.result[j] += (
            forward.perturbed_results[0, j] - forward.perturbed_results[1, j]
        ) / width


@inlined
def _directional_derivative(c, unknowns, forward, p):  # type: ignore[no-untyped-def]
    """Get the derivative of the unknowns along `seed` and, for a known, the parameter."""
    n_knowns = len(forward.stage_states)
    if forward.kinds[p] == KNOWN:
        forward.knowns[n_knowns] = forward.references[p]
        forward.seed[n_knowns] = 1.0
        n_knowns += 1
    for j in range(len(unknowns)):
        forward.result[j] = 0.0
    if n_knowns == 0 or len(unknowns) == 0:
        return 0
    return get_directional_derivative(
        c, unknowns, forward.knowns, n_knowns, forward.seed, forward.result
    )


@intrinsic
def instance_of(_typing_context: Any, c: Any, handle: Any) -> Any:
    """Return the component of another instance of the same FMU, whose functions are the same."""

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        component, given = operands
        copy = cgutils.alloca_once_value(builder, builder.load(component))
        handle = cgutils.gep_inbounds(builder, copy, 0, c.target.fields.index("handle"))
        builder.store(context.cast(builder, given, signature.args[1], types.intp), handle)
        return copy

    return c(c, handle), generate
