"""Effects bound to an experiment: their byte code, and the signals on which they depend."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from workers.core.library import Effects
from workers.effects.compiled import InnerEffects, compile_inner
from workers.effects.definition import EffectDefinition, define
from workers.effects.outputs import apply_output_effect
from workers.effects.signal_memory import MEMORIES, SampledSignal
from workers.errors import EffectError
from workers.fmu.description import ModelDescription, nearest
from workers.grid import SignalGrid
from workers.messages import Effect, Experiment, FloatArray, Input, IntArray, Model


@dataclass(frozen=True)
class BoundEffects:
    """The active effects of a task, for one experiment.

    Attributes
    ----------
    definitions, positions
        The effects, and the position of each effect's first coefficient in the task.
    experiment
        The experiment. A constant is added for each input that an effect needs and the data do not
        contain. Measured signals that no effect needs are removed.
    recorded
        The experiment's outputs, and other variables on which effects at outputs depend.
    inner
        The effects at derivatives, inputs and parameters; None without such effects.
    seen
        In co-simulation, signals whose values the FMU computes.
    """

    definitions: tuple[EffectDefinition, ...]
    positions: tuple[int, ...]
    experiment: Experiment
    recorded: tuple[str, ...]
    inner: InnerEffects | None
    seen: tuple[str, ...] = ()

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(given.variable for given in self.experiment.inputs)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the grid's columns: the FMU's inputs, then signals."""
        return _columns(self.experiment)

    def at_points(
        self,
        points: FloatArray,
        coefficients: FloatArray,
        model: Model,
        description: ModelDescription,
    ) -> Effects:
        """Return the effects that act while a simulation runs, for a batch of points."""
        if self.inner is None:
            return Effects()
        base = np.empty((len(points), len(self.inner.parameters)))
        for column, name in enumerate(self.inner.parameters):
            base[:, column] = self._base_values(name, points, model, description)
        references = [description.variables[name].reference for name in self.inner.parameters]
        effects = Effects(program=self.inner.program.address).hold(np.uint32, parameters=references)
        effects.n_states = self.inner.n_effect_states
        effects.held["program"] = self.inner.program
        return effects.hold(
            np.float64, fastest_rates=self._fastest_rates(coefficients), coefficients=coefficients,
            base=base,
        )  # fmt: skip

    def with_memory_effects(self, coefficients: FloatArray) -> Experiment:
        """Return the experiment with the inputs changed by effects with memory, for one point."""
        inputs = list(self.experiment.inputs)
        for definition, position in zip(self.definitions, self.positions, strict=True):
            if _has_memory(definition):
                which = self.inputs.index(definition.site.target)
                change, given = MEMORIES[definition.form.memory], inputs[which]
                signal = SampledSignal(given.times, given.values, given.interpolation)
                changed = change(signal, float(coefficients[position]))
                inputs[which] = replace(given, **changed._asdict())
        return replace(self.experiment, inputs=tuple(inputs))

    @property
    def has_memory(self) -> bool:
        """Whether an effect changes a complete input signal, so each point has its own grid."""
        return any(_has_memory(d) for d in self.definitions)

    def apply_to_outputs(
        self, grid: SignalGrid, outputs: FloatArray, coefficients: FloatArray
    ) -> None:
        """Apply the effects at outputs to the outputs of one point, in place."""
        for definition, position in zip(self.definitions, self.positions, strict=True):
            if definition.site.kind == "output":
                own = coefficients[position : position + len(definition.coefficients)]
                apply_output_effect(definition, own, grid, outputs, self.recorded, self.columns)

    def _fastest_rates(self, coefficients: FloatArray) -> FloatArray:
        """Return the fastest rate of own states at each point that coefficients determine."""
        rates = np.zeros(len(coefficients))
        for definition, position in zip(self.definitions, self.positions, strict=True):
            if definition.states and definition.site.kind != "output":
                for p, row in enumerate(coefficients):
                    own = row[position : position + len(definition.coefficients)]
                    rates[p] = max(rates[p], definition.fastest_rate(own))
        return rates

    def _base_values(
        self, name: str, points: FloatArray, model: Model, description: ModelDescription
    ) -> FloatArray:
        """Return the value of a parameter without its effects, at each point."""
        if name in model.parameters:
            return points[:, model.parameters.index(name)]
        start = dict(self.experiment.values).get(name, description.variables[name].start)
        return np.full(len(points), float(start if start is not None else np.nan))


def bind_effects(
    definitions: Sequence[tuple[EffectDefinition, int]],
    experiment: Experiment,
    description: ModelDescription,
    n_coefficients: int,
    *,
    model_exchange: bool,
) -> BoundEffects:
    """Bind active effects to an experiment.

    Parameters
    ----------
    definitions
        Each effect with the position of its first coefficient.
    experiment, description
        The experiment, and the model description of the FMU.
    n_coefficients
        Number of coefficients of all effects of a task.
    model_exchange
        Whether the FMU's own states are in the array of states (model exchange).
    """
    outputs = tuple(output.variable for output in experiment.outputs)
    all_definitions = [definition for definition, _ in definitions]
    seen = () if model_exchange else _seen(all_definitions, experiment, description)
    experiment_with_signals = _with_dependencies(all_definitions, experiment, description, seen)
    extra = [n for d in all_definitions if d.site.kind == "output" for n in _dependencies(d)]
    given = [n for n in _columns(experiment_with_signals) if n not in seen]
    extra = [n for n in extra if n not in (*given, *outputs)]
    inner_effects = [
        (d, p) for d, p in definitions if d.site.kind != "output" and not _has_memory(d)
    ]
    inner = None
    if inner_effects:
        states = description.states if model_exchange else ()
        inner_definitions, positions = zip(*inner_effects, strict=True)
        inner = compile_inner(
            inner_definitions, positions, states, _columns(experiment_with_signals), n_coefficients
        )
    return BoundEffects(
        definitions=tuple(all_definitions),
        positions=tuple(p for _, p in definitions),
        experiment=experiment_with_signals,
        recorded=(*outputs, *dict.fromkeys(extra)),
        inner=inner,
        seen=seen,
    )


def _has_memory(definition: EffectDefinition) -> bool:
    """Return whether an effect changes a complete input signal."""
    return definition.site.kind == "input" and bool(definition.form.memory)


def _columns(experiment: Experiment) -> tuple[str, ...]:
    return tuple(given.variable for given in (*experiment.inputs, *experiment.signals))


def _dependencies(definition: EffectDefinition) -> tuple[str, ...]:
    """Return the variables on which an effect depends, including the signal that it replaces."""
    if definition.site.kind in ("input", "output"):
        return (*definition.uses, definition.site.target)
    return definition.uses


def _seen(
    definitions: Sequence[EffectDefinition], experiment: Experiment, description: ModelDescription
) -> tuple[str, ...]:
    """Return the FMU's variables on which effects at inputs and parameters depend."""
    measured = {given.variable for given in experiment.signals}
    used = dict.fromkeys(n for d in definitions if d.site.kind != "output" for n in d.uses)
    read = [n for n in used if n in description.variables and description.variables[n].is_read]
    return tuple(name for name in read if name not in measured)


def _with_dependencies(
    definitions: Sequence[EffectDefinition],
    experiment: Experiment,
    description: ModelDescription,
    seen: tuple[str, ...],
) -> Experiment:
    """Return the experiment with exactly the signals on which effects depend."""
    ends = np.array([experiment.start, experiment.stop])
    read = tuple(Input(name, ends, np.zeros(2), "hold") for name in seen)
    needed = dict.fromkeys(name for d in definitions for name in _dependencies(d))
    signals = {given.variable: given for given in experiment.signals}
    driven = [given.variable for given in experiment.inputs]
    constants = []
    for name in needed:
        variable = description.variables.get(name)
        if variable is None and name not in signals:
            raise EffectError(
                f"experiment {experiment.id!r}: an effect needs the signal {name!r}, but the "
                f"experiment has no such signal; add it under signals{nearest(name, signals)}"
            )
        if variable is not None and variable.causality == "input" and name not in driven:
            constants.append(_constant_input(name, experiment, description))
    return replace(
        experiment,
        inputs=(*experiment.inputs, *constants),
        signals=(*(given for name, given in signals.items() if name in needed), *read),
    )


def _constant_input(name: str, experiment: Experiment, description: ModelDescription) -> Input:
    """Return a constant signal for an input that the data do not contain."""
    value = dict(experiment.values).get(name, description.variables[name].start)
    if value is None:
        raise EffectError(
            f"experiment {experiment.id!r}: an effect needs the input {name!r}, which has neither "
            "a column nor a start value; give it a value under values"
        )
    times = np.array([experiment.start, experiment.stop])
    return Input(name, times, np.full(2, float(value)), "hold")


class EffectBatch:
    """The effects of a batch of tasks, with their definitions for one FMU and its signals."""

    def __init__(
        self,
        effects: Sequence[Effect],
        description: ModelDescription,
        model: Model,
        signals: tuple[str, ...] = (),
    ) -> None:
        self._definitions = [define(e, description, model.interface, signals) for e in effects]
        sizes = [len(d.coefficients) for d in self._definitions]
        self._positions = np.cumsum([0, *sizes])[:-1].tolist()

    def groups(
        self, coefficients: FloatArray
    ) -> Iterator[tuple[IntArray, list[tuple[EffectDefinition, int]]]]:
        """Group the points with the same active effects, in order of first appearance.

        An effect with neutral coefficients is not simulated at all, so it changes no bit of the
        result.
        """
        pairs = list(zip(self._definitions, self._positions, strict=True))
        members: dict[tuple[bool, ...], list[int]] = {}
        for p, row in enumerate(coefficients):
            active = tuple(not d.is_neutral(row[a : a + len(d.coefficients)]) for d, a in pairs)
            members.setdefault(active, []).append(p)
        for active, rows in members.items():
            acting = [pair for pair, on in zip(pairs, active, strict=True) if on]
            yield np.array(rows, np.intp), acting
