"""Byte code for tests: of a form at a site of the spring, and of instructions one by one."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from support.problems.springs import FMU

from workers.core.assemble import MARK, OPERATIONS, Registers, assemble
from workers.effects.compiled import CompiledEquations, equations
from workers.effects.definition import TIME_SYMBOL, define
from workers.effects.forms import FORMS, SiteKind
from workers.fmu.description import describe_model
from workers.messages import Effect, Model, Solver

MODEL = Model("spring", FMU.read_bytes(), "model_exchange", Solver("rk4"), ())
SITES = {
    "derivative": "der(v)", "input": "input F", "parameter": "parameter c", "pair": "pair x,v",
}  # fmt: skip
SIMULATED = sorted(key for key, form in FORMS.items() if key[0] in SITES and not form.memory)
CODES = {name: code for code, name in enumerate(OPERATIONS)}


@dataclass(frozen=True)
class FormProgram:
    """The byte code of a form, its equations, and how many registers it is given."""

    code: bytes
    equations: CompiledEquations
    registers: Registers

    @property
    def n_given(self) -> int:
        r = self.registers
        return 1 + r.states + r.inputs + r.coefficients + r.base

    @property
    def n_before(self) -> int:
        changes = bool(self.equations.modify_inputs)
        return self.registers.inputs * changes + self.registers.parameters

    @property
    def sites(self):
        """Assignments to derivatives, in the order of the results."""
        return sorted(self.equations.add_derivatives, key=lambda a: not a.add)


def form_program(kind: SiteKind, name: str) -> FormProgram:
    """Of a form at the spring, behind one coefficient of another effect."""
    form = FORMS[kind, name]
    variables = ("x", "F")[: form.variables]
    if kind == "pair":
        variables = ("x - v",) if form.variables == 1 else ("x", "v")[: form.variables]
    description = describe_model(MODEL)
    definition = define(Effect("e", SITES[kind], name, variables), description, "model_exchange")
    laid_out = equations((definition,), (1,), description.states, ("F",))
    own, parameters = len(laid_out.start_states), len(laid_out.parameters)
    coefficients = 1 + len(definition.coefficients)
    registers = Registers(2 + own, own, 1, coefficients, parameters, parameters)
    code = assemble(
        registers, laid_out.locations, TIME_SYMBOL, laid_out.start_states, laid_out.modify_inputs,
        laid_out.add_derivatives,
    )  # fmt: skip
    return FormProgram(code, laid_out, registers)


def written(n_registers, n_states, pieces, sites=(), own=0, constants=()):
    """Bytes of a program with nothing but states and temporaries."""
    code = [[*piece, (0, 0, 0, 0)] for piece in pieces]
    header = struct.pack(
        "<8s16I", MARK, n_registers, n_states, own, 0, 0, 0, len(constants), 0, 0, len(sites),
        len(sites), *map(len, code), 0,
    )  # fmt: skip
    instructions = b"".join(struct.pack("<4H", *i) for piece in code for i in piece)
    return b"".join([
        header, struct.pack(f"<{len(constants)}d", *constants), instructions,
        b"".join(struct.pack("<2H", *site) for site in sites),
    ])  # fmt: skip


def evaluated(library, program, given, n_results, directions=None):
    """Results of a program; with derivatives of the given registers (registers, 1 + n)."""
    given = np.ascontiguousarray(given, float)
    if directions is None:
        results = np.zeros(n_results)
        code = library.core_evaluate(program.address, given.ctypes.data, results.ctypes.data)
    else:
        results = np.zeros((n_results, 1 + directions))
        code = library.core_evaluate_dual(
            program.address, given.ctypes.data, directions, results.ctypes.data
        )
    assert code == 0
    return results
