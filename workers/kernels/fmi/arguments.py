"""The arguments of the loops: one experiment, for many points, on one instance."""

from __future__ import annotations

from typing import NamedTuple

from workers.grid import SignalGrid
from workers.kernels.fmi.component import (
    FmiComponent,
    KernelWorkspace,
    StartValues,
    VariableReferences,
)
from workers.kernels.fmi.hooks import EffectHooks
from workers.kernels.fmi.initialise import SolverSettings
from workers.messages import FloatArray, IntArray


class KernelArguments(NamedTuple):
    """The arguments of a loop, in its order; the last four are what it fills.

    Attributes
    ----------
    c
        The instance.
    references, starts, grid
        Of the experiment.
    settings
        Of the solver.
    hooks
        Effects, see `workers.kernels.fmi.hooks`.
    points : (p, k)
        Start values of the reals, a row a point.
    bounds : (p,)
        Sums of squares above which a simulation may end early; infinite for none.
    work
        Memory.
    outputs : (p, n, y)
        The outputs at each time of the grid.
    codes, stopped_at : (p,)
        0, or what went wrong (see `workers.kernels.fmi.failure`), and the time of it.
    steps : (p,)
        Of the solver, where a simulation reaches its end.
    """

    c: FmiComponent
    references: VariableReferences
    starts: StartValues
    settings: SolverSettings
    hooks: EffectHooks
    grid: SignalGrid
    points: FloatArray
    bounds: FloatArray
    work: KernelWorkspace
    outputs: FloatArray
    codes: IntArray
    stopped_at: FloatArray
    steps: IntArray
