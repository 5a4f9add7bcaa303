"""An experiment with effects on it: what the compiled loops need beside the FMU and its data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from workers.description import Description
from workers.effects.compiled import Inner, compile_inner
from workers.effects.definition import Definition, define
from workers.effects.outputs import act_on_record
from workers.errors import EffectError
from workers.grid import Grid
from workers.kernels.hooks import Hooks, no_hooks
from workers.messages import Effect, Experiment, FloatArray, Input, IntArray, Model


@dataclass(frozen=True)
class Augmentation:
    """The effects of a task that do something, for one experiment.

    Attributes
    ----------
    definitions, positions
        The effects, and where the coefficients of each begin among those of the task.
    experiment
        The experiment with a constant signal for each input that an effect needs and the data do
        not drive.
    recorded
        The experiment's outputs, and what else effects at outputs depend on.
    inner
        The compiled effects at derivatives, inputs and parameters; None if there are none.
    """

    definitions: tuple[Definition, ...]
    positions: tuple[int, ...]
    experiment: Experiment
    recorded: tuple[str, ...]
    inner: Inner | None

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(given.variable for given in self.experiment.inputs)

    def hooks(
        self,
        grid: Grid,
        points: FloatArray,
        coefficients: FloatArray,
        model: Model,
        description: Description,
    ) -> Hooks:
        """What the loops call, for a batch of points on a grid."""
        if self.inner is None:
            return no_hooks(len(points))
        base = [self._base(name, points, model, description) for name in self.inner.parameters]
        references = [description.variables[name].reference for name in self.inner.parameters]
        return Hooks(
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

    def delayed(self, coefficients: FloatArray) -> Experiment:
        """The experiment with each delayed input shifted in time, for one point."""
        inputs = list(self.experiment.inputs)
        for definition, position in zip(self.definitions, self.positions, strict=True):
            if definition.site.kind == "input" and definition.form.delay:
                which = self.inputs.index(definition.site.target)
                shifted = inputs[which].times + float(coefficients[position])
                inputs[which] = replace(inputs[which], times=shifted)
        return replace(self.experiment, inputs=tuple(inputs))

    @property
    def delays(self) -> bool:
        """Whether an input is delayed, so that each point has a grid of its own."""
        return any(d.site.kind == "input" and d.form.delay for d in self.definitions)

    def act_on(self, grid: Grid, record: FloatArray, coefficients: FloatArray) -> None:
        """Let the effects at outputs act on one point's record."""
        for definition, position in zip(self.definitions, self.positions, strict=True):
            if definition.site.kind == "output":
                own = coefficients[position : position + len(definition.coefficients)]
                act_on_record(definition, own, grid, record, self.recorded, self.inputs)

    def _substeps(self, grid: Grid, coefficients: FloatArray) -> IntArray:
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
        self, name: str, points: FloatArray, model: Model, description: Description
    ) -> FloatArray:
        """The value of a parameter without its effects, at each point."""
        if name in model.parameters:
            return points[:, model.parameters.index(name)]
        known = dict(self.experiment.values).get(name, description.variables[name].start)
        return np.full(len(points), float(known if known is not None else np.nan))


def augment(
    definitions: Sequence[tuple[Definition, int]],
    experiment: Experiment,
    description: Description,
    *,
    exchange: bool,
) -> Augmentation:
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
    driven = {given.variable for given in experiment.inputs}
    extra_inputs: list[Input] = []
    extra_outputs: list[str] = []
    for definition, _ in definitions:
        needed = [*definition.uses]
        if definition.site.kind in ("input", "output"):
            needed.append(definition.site.target)
        for name in needed:
            if description.variables[name].causality == "input":
                if name not in driven:
                    driven.add(name)
                    extra_inputs.append(_constant(name, experiment, description))
            elif definition.site.kind == "output" and name not in (*outputs, *extra_outputs):
                extra_outputs.append(name)
    widened = replace(experiment, inputs=(*experiment.inputs, *extra_inputs))
    names = tuple(given.variable for given in widened.inputs)
    acting = [
        (d, p) for d, p in definitions
        if d.site.kind != "output" and not (d.site.kind == "input" and d.form.delay)
    ]  # fmt: skip
    inner = None
    if acting:
        states = description.states if exchange else ()
        inner = compile_inner(
            tuple(d for d, _ in acting), tuple(p for _, p in acting), states, names
        )
    return Augmentation(
        definitions=tuple(d for d, _ in definitions),
        positions=tuple(p for _, p in definitions),
        experiment=widened,
        recorded=(*outputs, *extra_outputs),
        inner=inner,
    )


def _constant(name: str, experiment: Experiment, description: Description) -> Input:
    """An input that the data do not drive, as a signal."""
    known = dict(experiment.values).get(name, description.variables[name].start)
    if known is None:
        raise EffectError(
            f"experiment {experiment.id!r}: an effect needs the input {name!r}, which no column "
            "drives and which has no start value; give it one under values"
        )
    times = np.array([experiment.start, experiment.stop])
    return Input(name, times, np.full(2, float(known)), "hold")


class Effects:
    """The effects of a batch of tasks, resolved against one FMU."""

    def __init__(self, effects: Sequence[Effect], description: Description, model: Model) -> None:
        self._definitions = [define(e, description, model.interface) for e in effects]
        sizes = [len(d.coefficients) for d in self._definitions]
        self._positions = np.cumsum([0, *sizes])[:-1].tolist()

    def groups(
        self, coefficients: FloatArray
    ) -> Iterator[tuple[IntArray, list[tuple[Definition, int]]]]:
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
