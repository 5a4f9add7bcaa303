"""Effects at outputs: they act on what was recorded, and need no simulation."""

from __future__ import annotations

from typing import NamedTuple

from numba.core.types import float64, int32, intp

from workers.kernels.fmi.calling import address_of, c_function, inlined, kernel
from workers.messages import FloatArray


class OutputHooks(NamedTuple):
    """Three functions by address, 0 where there is none.

    ``begin(t, states, record, raw, coefficients)`` starts the effect's own states,
    ``inside(t, states, record, raw, coefficients, slopes)`` gives their derivatives, and
    ``after(t, states, record, raw, coefficients, result)`` the output.
    """

    begin: int
    inside: int
    after: int


class OutputWorkspace(NamedTuple):
    """Memory of an effect at an output; `row` and `raw` are what was recorded at one time."""

    states: FloatArray
    trial: FloatArray
    stages: FloatArray
    row: FloatArray
    raw: FloatArray
    result: FloatArray


_call = c_function(int32, float64, intp, intp, intp, intp)
_call_into = c_function(int32, float64, intp, intp, intp, intp, intp)


@kernel
def edit_record(hooks, grid, record, column, coefficients, substeps, work):  # type: ignore[no-untyped-def]
    """Let an effect act on one column of a record.

    Between times of the grid, what was recorded counts as linear.

    Parameters
    ----------
    record : (n, y)
        Outputs at each time of the grid; changed in place.
    column
        The output at whose site the effect is.
    coefficients
        Of the effect.
    substeps
        Steps of the effect's own states from one time of the grid to the next.
    """
    for i in range(len(grid.times)):
        if i > 0 and hooks.inside != 0:
            for n in range(substeps):
                _advance(hooks, grid, record, i - 1, n, substeps, coefficients, work)
        _take(grid, record, i, 0.0, work)
        if i == 0 and hooks.begin != 0:
            _invoke(hooks.begin, grid.times[0], work.states, coefficients, work)
        _invoke_into(hooks.after, grid.times[i], work.states, coefficients, work, work.result)
        if i > 0:
            record[i - 1, column] = work.stages[4, 0]
        work.stages[4, 0] = work.result[0]
    record[len(grid.times) - 1, column] = work.stages[4, 0]


@inlined
def _advance(hooks, grid, record, i, n, substeps, coefficients, work):  # type: ignore[no-untyped-def]
    """Classic Runge-Kutta step n of so many from grid time i to the next, of the own states."""
    x, trial, k = work.states, work.trial, work.stages
    length = grid.times[i + 1] - grid.times[i]
    step = length / substeps
    for stage in range(4):
        reach = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
        for j in range(len(x)):
            trial[j] = x[j] + reach * step * k[max(stage - 1, 0), j] if stage > 0 else x[j]
        part = (n + reach) / substeps
        _take(grid, record, i, part, work)
        time = grid.times[i] + part * length
        _invoke_into(hooks.inside, time, trial, coefficients, work, k[stage])
    for j in range(len(x)):
        x[j] += step / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])


@inlined
def _take(grid, record, i, part, work):  # type: ignore[no-untyped-def]
    """Record and inputs at a part of the interval after grid time i."""
    after = min(i + 1, len(grid.times) - 1)
    for j in range(len(work.row)):
        work.row[j] = record[i, j] + part * (record[after, j] - record[i, j])
    length = grid.times[after] - grid.times[i]
    for j in range(len(work.raw)):
        work.raw[j] = grid.inputs[i, j] + part * length * grid.slopes[i, j]


@inlined
def _invoke(function, time, states, coefficients, work):  # type: ignore[no-untyped-def]
    _call(
        function,
        (
            time,
            address_of(states),
            address_of(work.row),
            address_of(work.raw),
            address_of(coefficients),
        ),
    )


@inlined
def _invoke_into(function, time, states, coefficients, work, target):  # type: ignore[no-untyped-def]
    _call_into(
        function,
        (
            time,
            address_of(states),
            address_of(work.row),
            address_of(work.raw),
            address_of(coefficients),
            address_of(target),
        ),
    )
