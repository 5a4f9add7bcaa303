"""Sensitivities S = dx/dtheta, carried along with the states by the steps that the states take.

The states alone control the steps, so the trajectory keeps its bits. After each accepted step its
stages are gone through once more with

    dS/dt = df/dx S + df/dtheta,    S(t0) = dx0/dtheta

whose right-hand side is one directional derivative of the FMU for each parameter: along a column of
S, and along the parameter too where the FMU takes it as a known. Where it does not, df/dtheta is a
central difference between two further instances of the FMU ("twins"), initialised a little above
and below the value. S is the derivative of the discrete solution for fixed steps.

Reference: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, section
II.6 ("Dependence on initial values and parameters": internal differentiation).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba.core import types
from numba.extending import intrinsic

from workers.kernels.fmi.calling import inlined, kernel
from workers.kernels.fmi.functions import (
    completed_integrator_step,
    get_derivatives,
    get_directional_derivative,
)
from workers.kernels.fmi.hooks import take_inputs
from workers.kernels.fmi.values import DISCARD, get_reals
from workers.kernels.model_exchange.moving import go_to
from workers.messages import FloatArray, IntArray

AT_START, KNOWN, TWINS = range(3)
"""How a parameter acts: on the initial states alone, as a known, or by differences of twins."""


class ForwardSensitivities(NamedTuple):
    """What sensitivities need: n states, y outputs, p parameters, and the k values of a point.

    Attributes
    ----------
    kinds, references, columns : (p,)
        How each parameter acts, its value reference, and its place in a point.
    handles : (p, 2)
        The instances that are initialised above and below its value; the simulated one itself,
        where there are no twins.
    values : (p, 2)
        Those values.
    slopes, asked : (n,), (a,)
        References of the states' derivatives, and of those outputs that are no states.
    places, states : (a,), (y,)
        Where each of the outputs asked for stands; which state an output is, or -1.
    knowns, seed : (n + 1,)
        References of the states and room for a parameter's; a direction in them.
    nodes, weights, finals : (s,), (s, s), (s,)
        The Runge-Kutta method: c, a and b.
    columns_now, stages : (p, n), (s, p, n)
        The columns of S, and their derivatives at each stage.
    at, found, sides, point : (n,), (max(n, a),), (2, max(n, a)), (k,)
        Memory.
    record : (times, p, y)
        Filled with dy/dtheta.
    """

    kinds: IntArray
    references: IntArray
    columns: IntArray
    handles: IntArray
    values: FloatArray
    slopes: IntArray
    asked: IntArray
    places: IntArray
    states: IntArray
    knowns: IntArray
    seed: FloatArray
    nodes: FloatArray
    weights: FloatArray
    finals: FloatArray
    columns_now: FloatArray
    stages: FloatArray
    at: FloatArray
    found: FloatArray
    sides: FloatArray
    point: FloatArray
    record: FloatArray


@kernel
def advance(c, references, hooks, grid, i, time, step, work, forward):  # type: ignore[no-untyped-def]
    """Carry S over a step whose stages are in `work`, before it is accepted. Returns the status.

    The FMU stands at the end of the step then, in the states of `work.trial`.
    """
    worst = 0
    for stage in range(len(forward.nodes)):
        _go_to_stage(forward, stage, step, work)
        reach = time + forward.nodes[stage] * step
        take_inputs(grid, i, reach, work)
        worst = max(worst, go_to(c, references, hooks, reach, forward.at, work))
        for p in range(len(forward.kinds)):
            _seed_stage(forward, stage, step, p)
            if worst < DISCARD:
                worst = max(worst, _slopes(c, references, hooks, reach, work, forward, p))
            for j in range(len(forward.at)):
                forward.stages[stage, p, j] = forward.found[j]
    _sum_stages(forward, step)
    if worst < DISCARD:
        worst = max(worst, _end_step(c, references, hooks, grid, i, time + step, work, forward))
    return worst


@inlined
def _go_to_stage(forward, stage, step, work):  # type: ignore[no-untyped-def]
    """The states of a stage, into `at`."""
    for j in range(len(forward.at)):
        slope = 0.0
        for before in range(stage):
            slope += forward.weights[stage, before] * work.stages[before, j]
        forward.at[j] = work.states[j] + step * slope


@inlined
def _seed_stage(forward, stage, step, p):  # type: ignore[no-untyped-def]
    """The column of S of a stage, into `seed`."""
    for j in range(len(forward.at)):
        slope = 0.0
        for before in range(stage):
            slope += forward.weights[stage, before] * forward.stages[before, p, j]
        forward.seed[j] = forward.columns_now[p, j] + step * slope


@inlined
def _sum_stages(forward, step):  # type: ignore[no-untyped-def]
    """S at the end of the step."""
    for p in range(len(forward.kinds)):
        for j in range(len(forward.at)):
            slope = 0.0
            for stage in range(len(forward.nodes)):
                slope += forward.finals[stage] * forward.stages[stage, p, j]
            forward.columns_now[p, j] += step * slope


@inlined
def _end_step(c, references, hooks, grid, i, time, work, forward):  # type: ignore[no-untyped-def]
    """Back to the end of the step, all instances; twins are told that it is complete."""
    take_inputs(grid, i, time, work)
    worst = go_to(c, references, hooks, time, work.trial, work)
    if c.completes_steps:
        for p in range(len(forward.kinds)):
            if forward.kinds[p] == TWINS:
                for side in range(2):
                    twin = instance_of(c, forward.handles[p, side])
                    worst = max(worst, go_to(twin, references, hooks, time, work.trial, work))
                    if worst < DISCARD:
                        worst = max(worst, completed_integrator_step(twin, work.info))
    return worst


@kernel
def _slopes(c, references, hooks, time, work, forward, p):  # type: ignore[no-untyped-def]
    """df/dx s + df/dtheta into `found`, where the FMU stands, s being `seed`. Gives the status."""
    n = len(forward.at)
    status = _along(c, forward.slopes, forward, p)
    if forward.kinds[p] != TWINS or n == 0:
        return status
    for side in range(2):
        twin = instance_of(c, forward.handles[p, side])
        if status < DISCARD:
            status = max(status, go_to(twin, references, hooks, time, forward.at, work))
        if status < DISCARD:
            status = max(status, get_derivatives(twin, forward.sides[side]))
    _add_difference(forward, p, n)
    return status


@kernel
def record_sensitivities(c, references, hooks, grid, i, work, forward):  # type: ignore[no-untyped-def]
    """dy/dtheta at grid time i, where the FMU stands. Returns the worst status."""
    worst = 0
    for p in range(len(forward.kinds)):
        for j in range(len(work.states)):
            forward.seed[j] = forward.columns_now[p, j]
            forward.at[j] = work.states[j]
        for place in range(len(forward.states)):
            if forward.states[place] >= 0:
                forward.record[i, p, place] = forward.seed[forward.states[place]]
        if len(forward.asked) > 0 and worst < DISCARD:
            worst = max(worst, _along(c, forward.asked, forward, p))
            if forward.kinds[p] == TWINS:
                worst = max(worst, _differ(c, references, hooks, grid.times[i], work, forward, p))
            for place in range(len(forward.asked)):
                forward.record[i, p, forward.places[place]] = forward.found[place]
    return worst


@inlined
def _differ(c, references, hooks, time, work, forward, p):  # type: ignore[no-untyped-def]
    """Add dg/dtheta to `found`, from the outputs of twins."""
    status = 0
    for side in range(2):
        twin = instance_of(c, forward.handles[p, side])
        if status < DISCARD:
            status = max(status, go_to(twin, references, hooks, time, forward.at, work))
        if status < DISCARD:
            status = max(status, get_reals(twin, forward.asked, forward.sides[side]))
    _add_difference(forward, p, len(forward.asked))
    return status


@inlined
def _add_difference(forward, p, count):  # type: ignore[no-untyped-def]
    width = forward.values[p, 0] - forward.values[p, 1]
    for j in range(count):
        forward.found[j] += (forward.sides[0, j] - forward.sides[1, j]) / width


@inlined
def _along(c, unknowns, forward, p):  # type: ignore[no-untyped-def]
    """The directional derivative of the unknowns along `seed`, and along the parameter."""
    n_knowns = len(forward.at)
    if forward.kinds[p] == KNOWN:
        forward.knowns[n_knowns] = forward.references[p]
        forward.seed[n_knowns] = 1.0
        n_knowns += 1
    for j in range(len(unknowns)):
        forward.found[j] = 0.0
    if n_knowns == 0 or len(unknowns) == 0:
        return 0
    return get_directional_derivative(
        c, unknowns, forward.knowns, n_knowns, forward.seed, forward.found
    )


@intrinsic
def instance_of(typing_context: Any, c: Any, handle: Any) -> Any:
    """The component of another instance of the same FMU, whose functions are the same."""

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        component, given = operands
        cast = context.cast(builder, given, signature.args[1], types.intp)
        return builder.insert_value(component, cast, c.fields.index("handle"))

    return c(c, handle), generate
