"""Forward sensitivities: derivatives of the outputs by the parameters, in one simulation."""

from __future__ import annotations

from ctypes import addressof
from dataclasses import dataclass

import numpy as np

from workers.core.failure import DISCARD_STATUS, FATAL_STATUS, FINISHED
from workers.core.library import Batch, Sensitivities, address_of, core
from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.fmu.instance import FmuInstance
from workers.fmu.variable import ModelVariable
from workers.messages import FloatArray, IntArray, Model
from workers.simulation.bind_experiment import BoundExperiment
from workers.simulation.integrator import FmuIntegrator

SOLVERS = ("dormand_prince", "rk4")
"""Solvers that support sensitivities."""
PARAMETER_DIFFERENCE_STEP = 6e-6
"""Relative step of a parameter for differences of instances and initial states: the cube root of
the rounding unit. Their only noise is rounding, because no simulation is involved."""
INITIAL_STATES, KNOWN, DIFFERENCES = range(3)
"""Kinds of parameters: acts only on initial states; is a known of the directional derivatives; or
is neither, so that differences of instances are used."""
NOT_AVAILABLE = -1
"""Kind of a parameter for which no sensitivity can be computed."""


@dataclass(frozen=True)
class SensitivityPass:
    """One point of an experiment, simulated with sensitivities instead of the solver's loop."""

    structure: Sensitivities

    def __call__(self, batch: Batch) -> int:
        core().core_sensitivities(addressof(batch), addressof(self.structure))
        return 1


class SensitivitySource:
    """Forward sensitivities of an FMU; the kinds of its parameters are determined once.

    Parameters
    ----------
    model, description
        The FMU.
    """

    def __init__(self, model: Model, description: ModelDescription) -> None:
        self._model, self._description = model, description
        self._kinds: IntArray | None = None
        self.perturbed: list[FmuInstance] = []
        """Instances for parameters whose derivatives are finite differences."""

    def unavailable_reason(self, bound: BoundExperiment) -> str:
        """Return why sensitivities are not available for an experiment; "" if they may be."""
        known, solver = self._description.variables, self._model.solver.name
        if self._model.reset in ("instance", "process"):
            return (
                "sensitivities need an instance that can be reset, but each simulation has a new "
                f"{self._model.reset}"
            )
        if self._model.interface != "model_exchange":
            return "sensitivities need the states, which an FMU provides only in model exchange"
        if not self._description.offer("model_exchange").provides_directional_derivatives:
            return "the FMU does not provide directional derivatives"
        if solver not in SOLVERS:
            return f"solver {solver!r} cannot compute sensitivities"
        jumps = any(v.variability == "discrete" for v in known.values()) and bound.grid.jumps.any()
        if self._description.event_indicators > 0 or jumps:
            return "the FMU has events, and sensitivities cannot be continued across them"
        unsupported = [
            n for n in (*self._description.states, *bound.outputs) if not _is_plain(known[n])
        ]
        if unsupported:
            return (
                f"{unsupported[0]!r} is not a float64 scalar, and only these have directional "
                "derivatives"
            )
        if set(self._derivatives()) < set(self._description.states):
            return "the FMU does not name the derivative of every state"
        return ""

    def prepare_pass(
        self, bound: BoundExperiment, point: FloatArray, kinds: IntArray, handle: int
    ) -> SensitivityPass:
        """Prepare the simulation of one point: the values of the model's parameters.

        `kinds` are those of `parameter_kinds`; `handle` is the simulating instance.
        """
        chosen = np.flatnonzero(kinds != NOT_AVAILABLE)
        states = self._references(self._description.states)
        outputs = self._references(bound.outputs)
        parameters = self._references(self._model.parameters)
        is_state = [int(np.flatnonzero(states == r)[0]) if r in states else -1 for r in outputs]
        output_positions = np.array([i for i, state in enumerate(is_state) if state < 0], np.int64)
        structure = Sensitivities(n=len(chosen), n_outputs=len(output_positions)).hold(
            np.float64,
            values=self._perturbed_values(point)[chosen],
            sensitivities=np.zeros((len(bound.grid.times), len(chosen), len(outputs))),
        )
        structure.hold(
            np.int64,
            kinds=kinds[chosen],
            positions=chosen,
            handles=self._handles(kinds[chosen], handle),
            output_positions=output_positions,
            output_states=is_state,
        )
        derivatives = tuple(self._derivatives()[s].name for s in self._description.states)
        structure.hold(
            np.uint32,
            references=parameters[chosen],
            states=states,
            derivatives=self._references(derivatives),
            outputs=outputs[output_positions],
        )
        return SensitivityPass(structure)

    def _handles(self, kinds: IntArray, handle: int) -> IntArray:
        """Return (parameters, 2) handles of instances, above and below each value."""
        handles = np.full((len(kinds), 2), handle, np.int64)
        instances = iter(self.perturbed)
        for row in np.flatnonzero(kinds == DIFFERENCES):
            handles[row] = [next(instances).component.handle for _ in range(2)]
        return handles

    def parameter_kinds(
        self, integrator: FmuIntegrator, bound: BoundExperiment, point: FloatArray
    ) -> IntArray | str:
        """Return the kinds of the model's parameters, or a message if the FMU does not start."""
        if self._kinds is not None:
            return self._kinds
        kinds = np.full(len(self._model.parameters), NOT_AVAILABLE, np.int64)
        for p, name in enumerate(self._model.parameters):
            variable = self._description.variables[name]
            if not _is_plain(variable):
                continue
            if variable.causality not in ("parameter", "input"):
                kinds[p] = INITIAL_STATES
                continue
            status = self._status_of_derivatives(integrator, bound, point, variable.reference)
            if status is None:
                return "the FMU could not be started to compute its directional derivatives"
            kinds[p] = KNOWN if status < DISCARD_STATUS else self._add_perturbed_instances()
        self._kinds = kinds
        return kinds

    def _status_of_derivatives(
        self, integrator: FmuIntegrator, bound: BoundExperiment, point: FloatArray, known: int
    ) -> int | None:
        """Return the status of directional derivatives by a variable; None without a start."""
        unknowns = np.array([v.reference for v in self._derivatives().values()], np.uint32)
        found = np.zeros(len(unknowns) + 1)
        statuses: list[int] = []

        def ask(batch: Batch) -> int:
            at, size = address_of(unknowns), len(unknowns)
            status = core().core_is_known(addressof(batch), at, size, known, address_of(found))
            statuses.append(status)
            return 1

        run = integrator.run(bound, point[None], loop=ask)
        if run.codes[0] != FINISHED:
            return None
        if statuses[-1] >= FATAL_STATUS:
            integrator.instance.replace()
        return statuses[-1]

    def close(self) -> None:
        for instance in self.perturbed:
            instance.free()

    def _add_perturbed_instances(self) -> int:
        """Add two instances if possible; return the resulting kind of the parameter."""
        if self._description.once_per_process or self._model.seats is not None:
            return NOT_AVAILABLE
        added: list[FmuInstance] = []
        try:
            for _ in range(2):
                added.append(FmuInstance(self._model, self._description))  # noqa: PERF401
        except ModelError:  # some FMUs allow only one instance without declaring it
            for instance in added:
                instance.free()
            return NOT_AVAILABLE
        self.perturbed += added
        return DIFFERENCES

    def _perturbed_values(self, point: FloatArray) -> FloatArray:
        """Return values above and below each parameter value, within bounds, (parameters, 2)."""
        known = [self._description.variables[name] for name in self._model.parameters]
        sizes = np.where(point == 0.0, [v.nominal for v in known], np.abs(point))
        lows = [-np.inf if v.low is None else v.low for v in known]
        highs = [np.inf if v.high is None else v.high for v in known]
        above = np.maximum(np.minimum(point + PARAMETER_DIFFERENCE_STEP * sizes, highs), point)
        below = np.minimum(np.maximum(point - PARAMETER_DIFFERENCE_STEP * sizes, lows), point)
        return np.column_stack([above, below])

    def _derivatives(self) -> dict[str, ModelVariable]:
        """Return the derivative variable of each state that has one."""
        found = {v.derivative_of: v for v in self._description.variables.values()}
        return {name: found[name] for name in self._description.states if name in found}

    def _references(self, names: tuple[str, ...]) -> IntArray:
        return np.array([self._description.variables[n].reference for n in names], np.uint32)


def _is_plain(variable: ModelVariable) -> bool:
    return variable.type == "Float64" and variable.size == 1
