"""The file with equations and variables that the precompiled wrapper of an exported FMU reads.

Its format is defined in `workers/core/wrapper/table.h`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Sequence
from typing import get_args

import sympy as sp

from cluster_est.model_export.wrapper_layout import Kind, WrapperLayout
from workers.core.assemble import EffectArray, Registers, assemble
from workers.core.library import TYPES
from workers.effects.definition import EffectDefinition, known_decay, known_rates
from workers.effects.expression import Max
from workers.effects.outputs import assigned, output_code, output_locations
from workers.effects.signal_memory import MEMORIES
from workers.fmu.variable import ModelVariable
from workers.messages import Value

TABLE_MARK = b"CEWRAP1\0"
NO_HISTORY = -1
"""Of an effect at an output that is neither a delay nor a backlash; see `table.h`."""


def wrapper_table(layout: WrapperLayout, guid: str) -> bytes:
    """Return the content of the file.

    Raises
    ------
    EffectError
        If an equation contains something that the core cannot compute.
    """
    fields = [
        *_model(layout, guid),
        *_inputs(layout),
        *_values(layout),
        *_effects(layout),
        *_translated(layout),
        *(program for i in layout.outputs for program in _output_programs(layout, i)),
    ]
    body = b"".join(
        struct.pack("<Q", len(field)) + field + bytes(-len(field) % 8) for field in fields
    )
    return TABLE_MARK + struct.pack("<II", zlib.crc32(body), len(body)) + body


def _doubles(values: Iterable[float]) -> bytes:
    return b"".join(struct.pack("<d", value) for value in values)


def _integers(values: Iterable[int]) -> bytes:
    return b"".join(struct.pack("<i", value) for value in values)


def _references(values: Iterable[int]) -> bytes:
    return b"".join(struct.pack("<I", value) for value in values)


def _text(text: str) -> bytes:
    return text.encode() + b"\0"


# ---- the model and its solver ---------------------------------------------------------------


def _model(layout: WrapperLayout, guid: str) -> list[bytes]:
    model, description = layout.repair.problem.model, layout.repair.description
    solver = model.solver
    eventful = description.event_indicators > 0 or any(
        v.variability == "discrete" for v in description.variables.values()
    )
    plain = [v for v in layout.inputs if layout.is_plain(v)]
    facts = (
        int(description.version == "3.0") + 2, layout.exchange, solver.name == "rk4",
        len(layout.states), description.event_indicators if layout.exchange else 0,
        layout.exchange and description.completes_steps, description.interpolates_inputs, eventful,
        sum(v.is_continuous for v in plain), len(layout.inputs),
    )  # fmt: skip
    atol = layout.tolerance if solver.atol is None else solver.atol
    settings = (solver.step or 0.0, layout.tolerance, atol, solver.max_steps, solver.rtol or 0.0)
    identifier = description.offer(model.interface).identifier
    return [
        _integers(map(int, facts)),
        _doubles(settings),
        *map(_text, (guid, description.guid, identifier)),
        _inner_program(layout),
        _rate_program(layout),
    ]


def _inner_program(layout: WrapperLayout) -> bytes:
    equations = layout.equations
    if not (equations.start_states or equations.modify_inputs or equations.add_derivatives):
        return b""
    return equations.code(len(layout.states), len(layout.columns), _n_coefficients(layout))


def _n_coefficients(layout: WrapperLayout) -> int:
    return sum(map(len, layout.repair.coefficients))


def _rate_program(layout: WrapperLayout) -> bytes:
    """Return code for the fastest rate of own states, if coefficients alone determine it."""
    if not layout.equations.start_states:
        return b""
    rates = [abs(rate) for i in layout.inner for rate in known_rates(layout.effect(i), ())]
    registers = Registers(0, 0, 0, _n_coefficients(layout), 0, 1)
    fastest = assigned(EffectArray.EFFECTIVE_PARAMETERS, [Max(sp.Integer(0), *rates)])
    return assemble(registers, layout.equations.locations, before=fastest)


# ---- variables ------------------------------------------------------------------------------


def _element(type_: str, reference: int, size: int, column: int = -1, value: float = 0.0) -> bytes:
    index = TYPES.index("Int64" if type_ == "Enumeration" else type_)
    return struct.pack("<4qd", index, reference, size, column, value)


def _inputs(layout: WrapperLayout) -> list[bytes]:
    plain = [v for v in layout.inputs if layout.is_plain(v)]
    signals = (own.reference for own in layout.added if own.kind == "SIGNAL")
    moving = [v for v in layout.inputs if v.is_continuous]
    found = _found(layout)
    raw = [found.get(v.name, v.start or 0.0) for v in layout.inputs]
    return [
        _references((*(v.reference for v in layout.inputs), *signals)),
        _references(v.reference for v in plain),
        _driven(layout, layout.inputs),
        _driven(layout, moving),
        _doubles((*raw, *(0.0 for _ in layout.signals))),
    ]


def _found(layout: WrapperLayout) -> dict[str, float]:
    """Return the numeric values of the run, by name."""
    repair = layout.repair
    known = {name: float(value) for name, value in repair.known if isinstance(value, float | int)}
    return {f.name: f.value for f in repair.parameters} | known


def _driven(layout: WrapperLayout, inputs: Sequence[ModelVariable]) -> bytes:
    """Return the elements of inputs that are not float64 scalars, as complete variables."""
    columns = {v.reference: i for i, v in enumerate(layout.inputs)}
    parts = []
    for place in layout.translated:
        references = range(place.first, place.first + place.size)
        if any(v.reference in references for v in inputs):
            parts += [
                _element(place.type, place.reference, place.size, columns.get(reference, -1))
                for reference in references
            ]
    return b"".join(parts)


def _values(layout: WrapperLayout) -> list[bytes]:
    repair, variables = layout.repair, layout.repair.description.variables
    found = _found(layout)
    own = [1.0] * len(layout.equations.start_states)
    parameters = layout.equations.parameters
    known = {kind: _known(layout, kind) for kind in ("integer", "boolean", "string")}
    return [
        _doubles(f.value for values in repair.coefficients for f in values),
        _doubles([*(variables[name].nominal for name in layout.states), *own]),
        _references(layout.reference(name) for name in parameters),
        _doubles(found.get(n, variables[n].start or 0.0) for n in parameters),
        _references(layout.reference(f.name) for f in layout.starts),
        _doubles(f.value for f in layout.starts),
        _references(reference for reference, _ in known["integer"]),
        _integers(int(value) for _, value in known["integer"]),
        _references(reference for reference, _ in known["boolean"]),
        _integers(int(bool(value)) for _, value in known["boolean"]),
        _references(reference for reference, _ in known["string"]),
        b"".join(_text(str(value)) for _, value in known["string"]),
    ]


def _known(layout: WrapperLayout, kind: str) -> list[tuple[int, Value]]:
    """Return the values of the run of a kind, without structural parameters."""
    variables = layout.repair.description.variables
    known = [(variables[name], value) for name, value in layout.repair.known]
    return [
        (v.reference, value)
        for v, value in known
        if v.kind == kind and v.causality != "structuralParameter"
    ]


def _translated(layout: WrapperLayout) -> list[bytes]:
    """Return tables of the variables of FMI 3.0 that have another form in FMI 2.0."""
    variables = layout.repair.description.variables
    places, elements, kept, at = [], [], list[float](), 0
    for v in layout.translated:
        places.append(struct.pack("<Iiii", v.first, v.size, at, len(kept) if v.starts else -1))
        elements += [_element(v.type, v.reference, v.size, i) for i in range(v.size)]
        kept += v.starts
        at += v.size
    sizes = [
        _element(variables[name].type, variables[name].reference, 1, value=float(value))
        for name, value in layout.repair.problem.model.structure
    ]
    outputs = [variables[n] for n in layout.repair.description.outputs if n in variables]
    read = [v.reference for v in outputs if v.kind == "real" and layout.is_plain(v)]
    tables = map(b"".join, (places, elements))
    return [*tables, _doubles(kept), b"".join(sizes), _references(read[:1])]


# ---- effects --------------------------------------------------------------------------------


def _effects(layout: WrapperLayout) -> list[bytes]:
    memories = [_memory(layout, i) for i in layout.memories]
    outputs = [_output_effect(layout, i) for i in layout.outputs]
    answered = [
        struct.pack("<Iiii", s.reference, get_args(Kind).index(s.kind), s.index, s.start)
        for s in layout.answered
    ]
    return [
        b"".join(map(_integers, memories)),
        b"".join(map(_integers, outputs)),
        _references(layout.reference(name) for name in layout.row),
        b"".join(answered),
        _references(layout.affected),
    ]


def _memory(layout: WrapperLayout, index: int) -> tuple[int, ...]:
    effect = layout.effect(index)
    column = layout.columns.index(effect.site.target)
    return _kind_of_memory(effect), column, layout.repair.positions[index]


def _kind_of_memory(effect: EffectDefinition) -> int:
    return list(MEMORIES).index(effect.form.memory)


def _output_effect(layout: WrapperLayout, index: int) -> tuple[int, ...]:
    effect, position = layout.effect(index), layout.repair.positions[index]
    column = layout.row.index(effect.site.target)
    memory = _kind_of_memory(effect) if effect.form.memory else NO_HISTORY
    first = layout.first_output_state(index) - layout.n_inner_states
    return column, memory, first, len(effect.states), position, len(effect.coefficients)


def _output_programs(layout: WrapperLayout, index: int) -> tuple[bytes, bytes]:
    """Return code of an effect at an output, and of the rate and the decay of its own states."""
    effect = layout.effect(index)
    if effect.form.memory:
        return b"", b""
    program = output_code(effect, layout.row, layout.columns)
    if not effect.states:
        return program, b""
    rates = [abs(rate) for rate in known_rates(effect, effect.uses)]
    motion = [Max(sp.Integer(0), *rates), known_decay(effect)]
    seen, n_coefficients = len(layout.columns) + len(layout.row), len(effect.coefficients)
    registers = Registers(0, 0, seen, n_coefficients, 0, 2)
    locations = output_locations(effect, layout.row, layout.columns)
    moved = assigned(EffectArray.EFFECTIVE_PARAMETERS, motion)
    return program, assemble(registers, locations, before=moved)
