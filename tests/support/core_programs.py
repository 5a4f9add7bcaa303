"""Byte code for tests: of a form at a site of the spring, and of instructions one by one."""

from __future__ import annotations

import ctypes
import struct
from dataclasses import dataclass
from pathlib import Path

import fuzz_core
import numpy as np
from support.problems.springs import FMU

from workers.core import build
from workers.core.assemble import CODE_MARK, OPERATIONS, Registers, assemble
from workers.effects.compiled import CompiledEquations, equations
from workers.effects.definition import define
from workers.effects.forms import FORMS, SiteKind
from workers.fmu.description import describe_model
from workers.messages import Effect, FloatArray, Model, Solver

MODEL = Model("spring", FMU.read_bytes(), "model_exchange", Solver("rk4"), ())
SITES = {
    "derivative": "der(v)", "input": "input F", "parameter": "parameter c", "pair": "pair x,v",
}  # fmt: skip
SIMULATED = sorted(key for key, form in FORMS.items() if key[0] in SITES and not form.memory)
CODES = {name: code for code, name in enumerate(OPERATIONS)}
SOURCES = Path(fuzz_core.__file__).parent / "fuzzing" / "core"
FAST, PLAIN = range(2)
"""Machines, as `machines.h` numbers them."""


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
        registers, laid_out.locations, laid_out.start_states, laid_out.modify_inputs,
        laid_out.add_derivatives,
    )  # fmt: skip
    return FormProgram(code, laid_out, registers)


def written(n_registers, n_states, pieces, sites=(), own=0, constants=()):
    """Bytes of a program with nothing but states and temporaries."""
    code = [[*piece, (0, 0, 0, 0)] for piece in pieces]
    header = struct.pack(
        "<8s16I", CODE_MARK, n_registers, n_states, own, 0, 0, 0, len(constants), 0, 0, len(sites),
        len(sites), *map(len, code), 0,
    )  # fmt: skip
    instructions = b"".join(struct.pack("<4H", *i) for piece in code for i in piece)
    return b"".join([
        header, struct.pack(f"<{len(constants)}d", *constants), instructions,
        b"".join(struct.pack("<2H", *site) for site in sites),
    ])  # fmt: skip


class Machines:
    """The machines that run byte code, with what a fuzzer compares them by; built from sources."""

    def __init__(self, folder: Path) -> None:
        core = [build.HERE / f"{name}.c" for name in ("program", "machine", "elementary")]
        file = folder / "machines.so"
        flags = [flag for flag in build.FLAGS if flag != "-fvisibility=hidden"]
        build.compile_to(file, [SOURCES / "machines.c", *core], flags)
        self._library = ctypes.CDLL(str(file))
        self._library.core_program.restype = ctypes.c_void_p
        self._library.core_program_free.argtypes = [ctypes.c_void_p]
        self._library.evaluate.argtypes = [ctypes.c_void_p, ctypes.c_int, *2 * [ctypes.c_void_p]]

    def evaluated(self, code: bytes, given, n_results: int, machine: int = FAST) -> FloatArray:
        """Return the results of byte code, given time, states, inputs and so on."""
        given, results = np.ascontiguousarray(given, float), np.zeros(n_results)
        wrong = ctypes.c_char_p()
        program = self._library.core_program(code, len(code), ctypes.byref(wrong))
        assert program, wrong.value
        self._library.evaluate(program, machine, given.ctypes.data, results.ctypes.data)
        self._library.core_program_free(program)
        return results
