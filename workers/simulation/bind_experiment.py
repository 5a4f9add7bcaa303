"""An experiment made ready for one model: its grid, and the FMU's references for its variables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workers.fmu.access import access
from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable
from workers.grid import SignalGrid, build_grid
from workers.kernels.fmi.component import StartValues, VariableReferences
from workers.messages import Experiment, FloatArray, Input, IntArray, Model
from workers.simulation.fixed_step import CommunicationPoints, communicate


@dataclass(frozen=True)
class BoundExperiment:
    """An experiment made ready for one model.

    Attributes
    ----------
    communication
        When the FMU communicates, if it cannot do so at all times of the grid.
    held
        The memory that strings stand in.
    """

    grid: SignalGrid
    communication: CommunicationPoints | None
    outputs: tuple[str, ...]
    starts: StartValues
    references: VariableReferences
    known: FloatArray
    held: IntArray

    @property
    def running(self) -> SignalGrid:
        """What the loops go along."""
        return self.grid if self.communication is None else self.communication.grid


def install(
    model: Model,
    description: ModelDescription,
    experiment: Experiment,
    recorded: tuple[str, ...] | None = None,
) -> BoundExperiment:
    """Lay an experiment on its grid and look up the FMU's references for it.

    `recorded` are the variables to record; the experiment's own if None.

    Raises
    ------
    ModelError
        If the FMU has no such variable, or it is of the wrong kind, or cannot communicate at the
        experiment's times.
    """
    where = f"experiment {experiment.id!r}"
    given = {n: v for n, v in experiment.values if n not in model.parameters}
    chosen = {n: description.variable(n, where) for n in given}
    texts = {n: str(given[n]) for n, v in chosen.items() if v.kind == "string"}
    structure = [v for v in chosen.values() if v.causality == "structuralParameter"]
    known = [v for n, v in chosen.items() if n not in texts and v not in structure]
    outputs = recorded or experiment.recorded
    experiment = replace(
        experiment, inputs=tuple(_held(description, each) for each in experiment.inputs)
    )
    grid = build_grid(experiment, outputs)

    def bases(variable: ModelVariable) -> list[float]:
        if variable.size == 1:
            return [variable.start or 0.0]
        own = (variable.reference, variable.type)
        found = [v for v in description.variables.values() if (v.reference, v.type) == own]
        starts = {v.element: v.start or 0.0 for v in found}
        return [starts.get(e, 0.0) for e in range(variable.size)]

    def at(names: Sequence[str]) -> list[ModelVariable]:
        return [description.variable(n, where) for n in names]

    inputs = at([each.variable for each in experiment.inputs])
    moving = [v if v.moves else None for v in inputs]
    first = len(model.parameters) + len(known)
    return BoundExperiment(
        grid=grid,
        communication=communicate(model, description, experiment, outputs, grid.times),
        outputs=outputs,
        starts=StartValues(
            structure=access([*[None] * first, *structure], bases),
            numbers=access([*at(model.parameters), *known], bases),
            strings=np.array([chosen[n].reference for n in texts], np.uint32),
            texts=(held := _texts(list(texts.values())))[0],
        ),
        references=VariableReferences(
            inputs=access(inputs, bases),
            moving=access(moving, bases),
            outputs=access(at(outputs), bases),
        ),
        known=np.array([float(given[v.name]) for v in [*known, *structure]], np.float64),
        held=held[1],
    )


def _held(description: ModelDescription, given: Input) -> Input:
    """An input whose variable changes at events alone cannot be in between two samples."""
    variable = description.variables.get(given.variable)
    if variable is None or variable.moves:
        return given
    return replace(given, interpolation="hold")


def _texts(texts: Sequence[str]) -> tuple[IntArray, IntArray]:
    """Addresses of strings that end with a zero byte, and the memory that holds them."""
    encoded = [text.encode() + b"\0" for text in texts]
    memory = np.frombuffer(bytearray(b"".join(encoded)) or bytearray(1), np.uint8)
    begins = np.cumsum([0, *(len(each) for each in encoded)], dtype=np.int64)[:-1]
    return begins + memory.ctypes.data, memory
