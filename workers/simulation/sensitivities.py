"""Derivatives of the outputs by the model's parameters, carried along with one simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numba import typeof

from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.fmu.instance import FmuInstance
from workers.fmu.variable import ModelVariable
from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.fmi.component import KernelWorkspace
from workers.kernels.fmi.failure import FATAL, FINISHED
from workers.kernels.fmi.hooks import EffectHooks
from workers.kernels.fmi.initialise import SolverSettings
from workers.kernels.fmi.values import DISCARD
from workers.kernels.model_exchange.forward_sensitivities import (
    AT_START,
    KNOWN,
    TWINS,
    ForwardSensitivities,
)
from workers.kernels.sensitivities import simulate_forward, takes_as_known
from workers.kernels.solvers.dormand_prince import NODES, WEIGHTS
from workers.messages import FloatArray, IntArray, Model
from workers.simulation.bind_experiment import BoundExperiment

TABLEAUS = {
    "dormand_prince": (NODES[:6].copy(), WEIGHTS[:6].copy(), WEIGHTS[6].copy()),
    "rk4": (
        np.array([0.0, 0.5, 0.5, 1.0]),
        np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1.0, 0]]),
        np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
    ),
}
RELATIVE_STEP = 6e-6
"""The cube root of the rounding unit: of a parameter, for differences of twins and initial states;
they are no simulations, so rounding is all their noise."""
UNKNOWN = -1
"""Beside the kinds of `forward_sensitivities`: neither a known nor twins."""


@dataclass(frozen=True)
class SensitivityPass:
    """One point of an experiment. Takes the place of a solver's batch function."""

    fixed: Literal[True] | None
    forward: ForwardSensitivities

    def __call__(self, asked: KernelArguments) -> int:
        """Simulate one point. Always returns 1."""
        asked.codes[0], asked.stopped_at[0] = simulate_forward(
            self.fixed, *asked[:6], asked.points[0], asked.work, self.forward, asked.outputs[0]
        )
        return 1


class SensitivitySource:
    """How sensitivities are had of one FMU; found out at the first simulation, then kept.

    Parameters
    ----------
    model, description
        The FMU.
    """

    def __init__(self, model: Model, description: ModelDescription) -> None:
        self._model, self._description = model, description
        self._kinds: IntArray | None = None
        self._twins: list[FmuInstance] = []

    def why_not(self, ready: BoundExperiment) -> str:
        """Why there are none for an experiment; "" where there may be."""
        known, solver = self._description.variables, self._model.solver.name
        if self._model.interface != "model_exchange":
            return "sensitivities need the states, which an FMU gives in model exchange only"
        if not self._description.offer("model_exchange").provides_directional_derivatives:
            return "the FMU provides no directional derivatives"
        if solver not in TABLEAUS:
            return f"solver {solver!r} carries no sensitivities along"
        jumps = any(v.variability == "discrete" for v in known.values()) and ready.grid.jumps.any()
        if self._description.event_indicators > 0 or jumps:
            return "the FMU has events, across which sensitivities cannot be carried"
        odd = [n for n in (*self._description.states, *ready.outputs) if not _is_plain(known[n])]
        if odd:
            return f"{odd[0]!r} is no float64 scalar, which alone have directional derivatives"
        if set(self._rates()) < set(self._description.states):
            return "the FMU does not name the derivative of every state"
        return ""

    def along(
        self, ready: BoundExperiment, point: FloatArray, kinds: IntArray, handle: int
    ) -> SensitivityPass:
        """Make ready for one point: the values of the model's parameters.

        `kinds` are those that `find_kinds` gave; `handle` is that of the instance that simulates.
        """
        chosen = np.flatnonzero(kinds != UNKNOWN)
        states, outputs = (
            self._references(self._description.states),
            self._references(ready.outputs),
        )
        parameters = self._references(self._model.parameters)
        n, y = len(states), len(outputs)
        is_state = [int(np.flatnonzero(states == r)[0]) if r in states else -1 for r in outputs]
        places = np.array([i for i, state in enumerate(is_state) if state < 0], np.int64)
        nodes, weights, finals = TABLEAUS[self._model.solver.name]
        handles = np.full((len(chosen), 2), handle, np.int64)
        twins = iter(self._twins)
        for row in np.flatnonzero(kinds[chosen] == TWINS):
            handles[row] = [next(twins).component.handle for _ in range(2)]
        widest = max(n, len(places))
        forward = ForwardSensitivities(
            kinds=kinds[chosen],
            references=parameters[chosen],
            columns=chosen,
            handles=handles,
            values=self._sides(point)[chosen],
            slopes=np.array([self._rates()[s].reference for s in self._description.states], "u4"),
            asked=outputs[places],
            places=places,
            states=np.array(is_state, np.int64),
            knowns=np.append(states, np.uint32(0)),
            seed=np.zeros(n + 1),
            nodes=nodes,
            weights=weights,
            finals=finals,
            columns_now=np.zeros((len(chosen), n)),
            stages=np.zeros((len(nodes), len(chosen), n)),
            at=np.zeros(n),
            found=np.zeros(widest),
            sides=np.zeros((2, widest)),
            point=np.zeros(len(point) + len(ready.known)),
            record=np.zeros((len(ready.grid.times), len(chosen), y)),
        )
        return SensitivityPass(True if self._model.solver.name == "rk4" else None, forward)

    def compile(
        self, ready: BoundExperiment, point: FloatArray, arguments: tuple[Any, ...]
    ) -> None:
        """Have the loops compiled for one point, whose other arguments are those of `start`."""
        along = self.along(ready, point, np.full(len(point), KNOWN), 0)
        record = np.empty((len(ready.grid.times), len(ready.outputs)))
        given = (along.fixed, *arguments, along.forward, record)
        simulate_forward.compile(tuple(typeof(each) for each in given))
        references, found = np.zeros(1, np.uint32), np.zeros(1)
        given = (*arguments, references, references, found)
        takes_as_known.compile(tuple(typeof(each) for each in given))

    def find_kinds(
        self,
        instance: FmuInstance,
        ready: BoundExperiment,
        settings: SolverSettings,
        hooks: EffectHooks,
        row: FloatArray,
        work: KernelWorkspace,
    ) -> IntArray | str:
        """How each of the model's parameters acts; a sentence where the FMU does not even start."""
        if self._kinds is not None:
            return self._kinds
        kinds = np.full(len(self._model.parameters), UNKNOWN, np.int64)
        unknowns = np.array([v.reference for v in self._rates().values()], np.uint32)
        for p, name in enumerate(self._model.parameters):
            variable = self._description.variables[name]
            if not _is_plain(variable):
                continue
            if variable.causality not in ("parameter", "input"):
                kinds[p] = AT_START
                continue
            found = np.zeros(len(unknowns) + 1)
            known = np.array([variable.reference], np.uint32)
            code, status = takes_as_known(
                instance.component, ready.references, ready.starts, settings, hooks, ready.grid,
                row, work, unknowns, known, found,
            )  # fmt: skip
            if max(status, 4 if code >= FATAL else 0) >= 4:
                instance.renew()
            if code != FINISHED:
                return "the FMU could not be started to be asked for its directional derivatives"
            kinds[p] = KNOWN if status < DISCARD else self._add_twins()
        self._kinds = kinds
        return kinds

    def forget_twins(self) -> None:
        """Replace the twins after a fatal error."""
        for twin in self._twins:
            twin.renew()

    def close(self) -> None:
        for twin in self._twins:
            twin.free()

    def _add_twins(self) -> int:
        """Two more instances, where there may be some. Returns the kind of the parameter then."""
        if self._description.once_per_process:
            return UNKNOWN
        made: list[FmuInstance] = []
        try:
            for _ in range(2):
                made.append(FmuInstance(self._model, self._description))  # noqa: PERF401
        except ModelError:  # there may be one only, though the FMU does not say so
            for twin in made:
                twin.free()
            return UNKNOWN
        self._twins += made
        return TWINS

    def _sides(self, point: FloatArray) -> FloatArray:
        """(parameters, 2): above and below each value, within the bounds that the FMU declares."""
        known = [self._description.variables[name] for name in self._model.parameters]
        sizes = np.where(point == 0.0, [v.nominal for v in known], np.abs(point))
        lows = [-np.inf if v.low is None else v.low for v in known]
        highs = [np.inf if v.high is None else v.high for v in known]
        above = np.maximum(np.minimum(point + RELATIVE_STEP * sizes, highs), point)
        below = np.minimum(np.maximum(point - RELATIVE_STEP * sizes, lows), point)
        return np.column_stack([above, below])

    def _rates(self) -> dict[str, ModelVariable]:
        """The derivative of each state."""
        found = {v.derivative_of: v for v in self._description.variables.values()}
        return {name: found[name] for name in self._description.states if name in found}

    def _references(self, names: tuple[str, ...]) -> IntArray:
        return np.array([self._description.variables[n].reference for n in names], np.uint32)


def _is_plain(variable: ModelVariable) -> bool:
    return variable.type == "Float64" and variable.size == 1
