"""An experiment with effects on it: what the compiled loops need beside the FMU and its data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from workers.effects.compiled import InnerEffects, compile_inner
from workers.effects.definition import EffectDefinition, define
from workers.effects.memory import MEMORIES
from workers.effects.outputs import act_on_record
from workers.errors import EffectError
from workers.fmu.description import ModelDescription, nearest
from workers.grid import SignalGrid
from workers.kernels.fmi.hooks import EffectHooks, no_hooks
from workers.messages import Effect, Experiment, FloatArray, Input, IntArray, Model


@dataclass(frozen=True)
class BoundEffects:
    """The effects of a task that do something, for one experiment.

    Attributes
    ----------
    definitions, positions
        The effects, and where the coefficients of each begin among those of the task.
    experiment
        The experiment with a constant for each input that an effect needs and the data do not
        drive, and of its measured signals only those that are needed.
    recorded
        The experiment's outputs, and what else effects at outputs depend on.
    inner
        The compiled effects at derivatives, inputs and parameters; None if there are none.
    """

    definitions: tuple[EffectDefinition, ...]
    positions: tuple[int, ...]
    experiment: Experiment
    recorded: tuple[str, ...]
    inner: InnerEffects | None

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(given.variable for given in self.experiment.inputs)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the grid's columns: the FMU's inputs, then signals."""
        return _columns(self.experiment)

    def hooks(
        self,
        grid: SignalGrid,
        points: FloatArray,
        coefficients: FloatArray,
        model: Model,
        description: ModelDescription,
    ) -> EffectHooks:
        """What the loops call, for a batch of points on a grid."""
        if self.inner is None:
            return no_hooks(len(points))
        base = [self._base(name, points, model, description) for name in self.inner.parameters]
        references = [description.variables[name].reference for name in self.inner.parameters]
        return EffectHooks(
            begin=self.inner.begin.address if self.inner.begin else 0,
            before=self.inner.before.address if self.inner.before else 0,
            inside=self.inner.inside.address if self.inner.inside else 0,
            parameters=np.array(references, np.uint32),
            substeps=self._substeps(grid, coefficients),
            coefficients=np.ascontiguousarray(coefficients),
            base=np.ascontiguousarray(np.column_stack(base))
            if base
            else np.zeros((len(points), 0)),
        )

    def remembered(self, coefficients: FloatArray) -> Experiment:
        """The experiment with the inputs that effects change as a whole, for one point."""
        inputs = list(self.experiment.inputs)
        for definition, position in zip(self.definitions, self.positions, strict=True):
            if _remembers(definition):
                which = self.inputs.index(definition.site.target)
                change, old = MEMORIES[definition.form.memory], inputs[which]
                times, values = change(old.times, old.values, float(coefficients[position]))
                inputs[which] = replace(old, times=times, values=values)
        return replace(self.experiment, inputs=tuple(inputs))

    @property
    def remembers(self) -> bool:
        """Whether an input is changed as a whole, so that each point has a grid of its own."""
        return any(_remembers(d) for d in self.definitions)

    def act_on(self, grid: SignalGrid, record: FloatArray, coefficients: FloatArray) -> None:
        """Let the effects at outputs act on one point's record."""
        for definition, position in zip(self.definitions, self.positions, strict=True):
            if definition.site.kind == "output":
                own = coefficients[position : position + len(definition.coefficients)]
                act_on_record(definition, own, grid, record, self.recorded, self.columns)

    def _substeps(self, grid: SignalGrid, coefficients: FloatArray) -> IntArray:
        """Of each point, for own states that are integrated between communication points."""
        longest = float(np.diff(grid.times).max())
        counts = np.ones(len(coefficients), np.int64)
        for definition, position in zip(self.definitions, self.positions, strict=True):
            if definition.states and definition.site.kind != "output":
                for p, row in enumerate(coefficients):
                    own = row[position : position + len(definition.coefficients)]
                    counts[p] = max(counts[p], definition.substeps(own, longest))
        return counts

    def _base(
        self, name: str, points: FloatArray, model: Model, description: ModelDescription
    ) -> FloatArray:
        """The value of a parameter without its effects, at each point."""
        if name in model.parameters:
            return points[:, model.parameters.index(name)]
        known = dict(self.experiment.values).get(name, description.variables[name].start)
        return np.full(len(points), float(known if known is not None else np.nan))


def augment(
    definitions: Sequence[tuple[EffectDefinition, int]],
    experiment: Experiment,
    description: ModelDescription,
    *,
    exchange: bool,
) -> BoundEffects:
    """Prepare an experiment for effects that do something.

    Parameters
    ----------
    definitions
        Each effect with the position of its first coefficient.
    experiment, description
        What they act on.
    exchange
        Whether the FMU's own states are in the array of states (model exchange).
    """
    outputs = tuple(output.variable for output in experiment.outputs)
    known = [definition for definition, _ in definitions]
    widened = _widened(known, experiment, description)
    extra = [n for d in known if d.site.kind == "output" for n in _needed(d)]
    extra = [n for n in extra if n not in (*_columns(widened), *outputs)]
    acting = [(d, p) for d, p in definitions if d.site.kind != "output" and not _remembers(d)]
    inner = None
    if acting:
        states = description.states if exchange else ()
        chosen, positions = zip(*acting, strict=True)
        inner = compile_inner(chosen, positions, states, _columns(widened))
    return BoundEffects(
        definitions=tuple(known),
        positions=tuple(p for _, p in definitions),
        experiment=widened,
        recorded=(*outputs, *dict.fromkeys(extra)),
        inner=inner,
    )


def _remembers(definition: EffectDefinition) -> bool:
    """Whether it changes an input as a whole."""
    return definition.site.kind == "input" and bool(definition.form.memory)


def _columns(experiment: Experiment) -> tuple[str, ...]:
    return tuple(given.variable for given in (*experiment.inputs, *experiment.signals))


def _needed(definition: EffectDefinition) -> tuple[str, ...]:
    """What an effect depends on, with the signal that it takes the place of."""
    if definition.site.kind in ("input", "output"):
        return (*definition.uses, definition.site.target)
    return definition.uses


def _widened(
    definitions: Sequence[EffectDefinition], experiment: Experiment, description: ModelDescription
) -> Experiment:
    """The experiment with all that effects depend on, and no signal beside."""
    needed = dict.fromkeys(name for d in definitions for name in _needed(d))
    signals = {given.variable: given for given in experiment.signals}
    driven = [given.variable for given in experiment.inputs]
    constants = []
    for name in needed:
        variable = description.variables.get(name)
        if variable is None and name not in signals:
            raise EffectError(
                f"experiment {experiment.id!r}: an effect needs the signal {name!r}, which it "
                f"must have under signals{nearest(name, signals)}"
            )
        if variable is not None and variable.causality == "input" and name not in driven:
            constants.append(_constant(name, experiment, description))
    return replace(
        experiment,
        inputs=(*experiment.inputs, *constants),
        signals=tuple(given for name, given in signals.items() if name in needed),
    )


def _constant(name: str, experiment: Experiment, description: ModelDescription) -> Input:
    """An input that the data do not drive, as a signal."""
    known = dict(experiment.values).get(name, description.variables[name].start)
    if known is None:
        raise EffectError(
            f"experiment {experiment.id!r}: an effect needs the input {name!r}, which no column "
            "drives and which has no start value; give it one under values"
        )
    times = np.array([experiment.start, experiment.stop])
    return Input(name, times, np.full(2, float(known)), "hold")


class EffectBatch:
    """The effects of a batch of tasks, resolved against one FMU and the measured signals."""

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
        """Points in groups with the same effects doing something, in order of first appearance.

        An effect whose coefficients are neutral is left out of the simulation altogether, which is
        why it changes no bit of it.
        """
        pairs = list(zip(self._definitions, self._positions, strict=True))
        members: dict[tuple[bool, ...], list[int]] = {}
        for p, row in enumerate(coefficients):
            active = tuple(not d.neutral(row[a : a + len(d.coefficients)]) for d, a in pairs)
            members.setdefault(active, []).append(p)
        for active, rows in members.items():
            chosen = [pair for pair, on in zip(pairs, active, strict=True) if on]
            yield np.array(rows, np.intp), chosen
