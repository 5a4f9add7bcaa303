"""Equations of effects as byte code for the core.

The code has no branches: each instruction computes one register from one or two others. Common
subexpressions are computed once, and values that depend only on coefficients once a simulation.
Sums and products are evaluated in SymPy's order, so the same equations always give the same bits.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum, auto
from functools import reduce
from itertools import accumulate
from typing import Any

import sympy as sp
from sympy.logic.boolalg import Boolean

from workers.errors import EffectError

OPERATIONS = (
    "END", "MOVE", "ADD", "MULTIPLY", "SUBTRACT", "DIVIDE", "LEAST", "LARGEST", "NEGATE",
    "ABSOLUTE", "SIGN", "ROOT", "EXP", "LOG", "SIN", "COS", "TAN", "TANH", "ATAN", "POW", "LESS",
    "LESS_OR_EQUAL", "EQUAL", "UNEQUAL", "AND", "OR", "NOT", "CHOOSE",
)  # fmt: skip
"""Operations in the order of program.h."""
CODE_MARK = b"CECORE1\0"
MOST_REGISTERS = 2**16 - 1
_CODES = {name: code for code, name in enumerate(OPERATIONS)}
_FUNCTIONS: dict[type[sp.Basic], str] = {
    sp.Abs: "ABSOLUTE",
    sp.sign: "SIGN",
    sp.exp: "EXP",
    sp.log: "LOG",
    sp.sin: "SIN",
    sp.cos: "COS",
    sp.tan: "TAN",
    sp.tanh: "TANH",
    sp.atan: "ATAN",
}
_COMPARISONS: dict[type[sp.Basic], tuple[str, bool]] = {
    sp.StrictLessThan: ("LESS", False),
    sp.LessThan: ("LESS_OR_EQUAL", False),
    sp.StrictGreaterThan: ("LESS", True),
    sp.GreaterThan: ("LESS_OR_EQUAL", True),
    sp.Equality: ("EQUAL", False),
    sp.Unequality: ("UNEQUAL", False),
}
"""Operations, and whether the two sides are exchanged."""
_MOST_MULTIPLICATIONS = 64
"""Largest integer power that is computed by multiplications."""
TIME_SYMBOL = sp.Symbol("t", real=True)


class EffectArray(StrEnum):
    """Arrays that equations of effects read and write."""

    STATES = auto()
    INPUTS = auto()
    COEFFICIENTS = auto()
    BASE = auto()
    EFFECTIVE_INPUTS = auto()
    EFFECTIVE_PARAMETERS = auto()
    DERIVATIVES = auto()


@dataclass(frozen=True)
class Assignment:
    """The assignment `target[index] = value`, or `+=`."""

    target: EffectArray
    index: int
    value: sp.Expr
    add: bool = False


Locations = dict[sp.Symbol, tuple[EffectArray, int]]
"""(array, index) of each symbol."""


@dataclass(frozen=True)
class Registers:
    """Numbers of registers of each kind.

    Attributes
    ----------
    states, own
        States of the FMU and of effects together; states of effects, which come last.
    inputs
        Inputs and signals. For an effect at an output, the outputs follow them.
    coefficients
        Coefficients in a row of the task, including those of other effects.
    base, parameters
        Parameters that effects change: values without effects, and values with effects. Other
        computed values, such as an output with its effect, also count as parameters.
    """

    states: int
    own: int
    inputs: int
    coefficients: int
    base: int = 0
    parameters: int = 0


def assemble(
    registers: Registers,
    locations: Locations,
    start: Sequence[Assignment] = (),
    before: Sequence[Assignment] = (),
    after: Sequence[Assignment] = (),
) -> bytes:
    """Return the byte code of effects.

    Parameters
    ----------
    registers
        Numbers of registers.
    locations
        Locations of all symbols of the equations except the time, which is `TIME_SYMBOL`.
    start, before, after
        Assignments to own states at the start; to effective inputs and parameters; and to
        derivatives. Within each group, all values are read before any is written.

    Raises
    ------
    EffectError
        If an equation contains something that the core cannot compute, or needs too many registers.
    """
    code = _Code(registers)
    code.write_start(start, locations)
    code.write_before(before, locations)
    code.write_after(after, locations)
    return code.to_bytes(changes_inputs=bool(before))


_Instruction = tuple[str, int, int, int]
"""Operation, register that it writes, and two registers that it reads."""
_Known = dict[tuple[str, int, int, int], int]
"""Registers of values that are already computed, by operation and operands."""
ONCE, START, BEFORE, AFTER = range(4)


@dataclass
class _Code:
    """Pieces of unfinished code, and the contents of the registers."""

    registers: Registers
    pieces: list[list[_Instruction]] = field(default_factory=lambda: [[], [], [], []])
    sites: list[tuple[bool, int, int]] = field(default_factory=list)
    constants: dict[bytes, int] = field(default_factory=dict)
    _fixed: set[int] = field(default_factory=set)
    _temporaries: int = 0
    _first_temporary = 1_000_000
    """First number of temporary registers until the number of constants is known."""

    def __post_init__(self) -> None:
        r = self.registers
        self._sizes = {
            EffectArray.STATES: r.states,
            EffectArray.INPUTS: r.inputs,
            EffectArray.COEFFICIENTS: r.coefficients,
            EffectArray.BASE: r.base,
        }
        first = accumulate(self._sizes.values(), initial=1)
        self._first = dict(zip((*self._sizes, EffectArray.EFFECTIVE_INPUTS), first, strict=True))
        self._first_effective = self._first[EffectArray.EFFECTIVE_INPUTS]
        self._known: _Known = {}

    def write_start(self, given: Sequence[Assignment], where: Locations) -> None:
        """Write the initial values of own states."""
        for assignment, result in self._write(START, given, where):
            to = self._first[EffectArray.STATES] + assignment.index
            self.pieces[START].append(("MOVE", to, result, 0))

    def write_before(self, given: Sequence[Assignment], where: Locations) -> None:
        """Write effective inputs and parameters, if possible directly into their registers."""
        for assignment, result in self._write(BEFORE, given, where):
            at_parameters = assignment.target == EffectArray.EFFECTIVE_PARAMETERS
            behind = self.registers.inputs if at_parameters else 0
            self._place(self._first_effective + behind + assignment.index, result)

    def write_after(self, given: Sequence[Assignment], where: Locations) -> None:
        """Write values that the core adds to derivatives or assigns to them."""
        for assignment, result in self._write(AFTER, given, where):
            self.sites.append((not assignment.add, assignment.index, result))

    def _write(
        self, piece: int, given: Sequence[Assignment], where: Locations
    ) -> list[tuple[Assignment, int]]:
        """Write equations; return each assignment with the register of its value.

        The symbols are first given short names, which determine SymPy's order of sums and products.
        """
        used = set().union(*(a.value.free_symbols for a in given)) - {TIME_SYMBOL}
        short = {s: sp.Symbol(f"s{i}", real=True) for i, s in enumerate(sorted(used, key=str))}
        values = [a.value.xreplace(short) for a in given]
        common, reduced = sp.cse(values, symbols=sp.numbered_symbols("c"))
        writer = _Writer(self, piece, {ONCE: self._known, piece: {}})
        writer.define(TIME_SYMBOL, 0)
        for symbol, local in short.items():
            writer.define(local, self._place_of(symbol, *where[symbol]))
        for symbol, value in common:
            writer.define(symbol, writer.write(value))
        return [(a, writer.write(value)) for a, value in zip(given, reduced, strict=True)]

    def _place_of(self, symbol: sp.Symbol, array: EffectArray, index: int) -> int:
        """Return the register of an array element that equations read."""
        if index >= self._sizes[array]:
            raise EffectError(
                f"effects: {symbol} is entry {index + 1} of {array}, which has only "
                f"{self._sizes[array]} entries; give a value for each"
            )
        return self._first[array] + index

    def _place(self, to: int, result: int) -> None:
        code = self.pieces[BEFORE]
        written = [i for i, each in enumerate(code) if each[1] == result]
        if len(written) == 1 and code[written[0]][0] not in ("MOVE", "CHOOSE"):
            moved = {result: to}
            self.pieces[BEFORE] = [
                (name, moved.get(out, out), moved.get(a, a), moved.get(b, b))
                for name, out, a, b in code
            ]
        else:
            code.append(("MOVE", to, result, 0))

    def is_fixed(self, register: int) -> bool:
        """Return whether a register keeps its value during a simulation."""
        if register < 0:
            return True
        first = self._first[EffectArray.COEFFICIENTS]
        return first <= register < self._first_effective or register in self._fixed

    def constant(self, value: float) -> int:
        """Return the provisional register of a constant, which is negative."""
        bits = struct.pack("<d", value)
        return -1 - self.constants.setdefault(bits, len(self.constants))

    def temporary(self, *, fixed: bool) -> int:
        """Return an unused register."""
        self._temporaries += 1
        register = self._first_temporary + self._temporaries
        if fixed:
            self._fixed.add(register)
        return register

    def to_bytes(self, *, changes_inputs: bool) -> bytes:
        """Number the registers and return the byte code."""
        r = self.registers
        first_constant = self._first_effective + r.inputs * changes_inputs + r.parameters
        first_temporary = first_constant + len(self.constants)
        total = first_temporary + self._temporaries
        if total > MOST_REGISTERS:
            raise EffectError(
                f"effects: must need at most {MOST_REGISTERS} numbers, but need {total}; use fewer "
                "effects or shorter equations"
            )

        def numbered(register: int) -> int:
            if register < 0:
                return first_constant - register - 1
            if register > self._first_temporary:
                return first_temporary + register - self._first_temporary - 1
            return register

        pieces = [[*piece, ("END", 0, 0, 0)] for piece in self.pieces]
        sites = sorted(self.sites, key=lambda site: site[0])
        header = struct.pack(
            "<8s16I", CODE_MARK, total, r.states, r.own, r.inputs, r.coefficients, r.base,
            len(self.constants), r.parameters, changes_inputs, len(sites),
            sum(not own for own, _, _ in sites), *map(len, pieces), 0,
        )  # fmt: skip
        instructions = [
            struct.pack("<4H", _CODES[name], *map(numbered, operands))
            for piece in pieces
            for name, *operands in piece
        ]
        added = [struct.pack("<2H", state, numbered(at)) for _, state, at in sites]
        return b"".join([header, *self.constants, *instructions, *added])


class _Writer:
    """Writes the instructions of expressions to a piece of code, or to `ONCE` if they are fixed."""

    def __init__(self, code: _Code, piece: int, known: dict[int, _Known]) -> None:
        self._code, self._piece, self._known = code, piece, known
        self._registers: dict[sp.Symbol, int] = {}

    def define(self, symbol: sp.Symbol, register: int) -> None:
        """Assign a register to a symbol."""
        self._registers[symbol] = register

    def write(self, value: sp.Expr) -> int:
        """Write the instructions of an expression, and return its register.

        Raises
        ------
        EffectError
            If the expression contains an unknown function.
        """
        if value.is_Symbol:
            return self._registers[value]
        if value.is_number:
            return self._code.constant(float(value))
        if isinstance(value, sp.Add):
            return self._chain("ADD", value.as_ordered_terms())
        if isinstance(value, sp.Mul):
            return self._product(value)
        if isinstance(value, sp.Pow):
            return self._power(value.base, value.exp)
        if isinstance(value, sp.Piecewise):
            return self._choice(value)
        if isinstance(value, Boolean):  # a condition that several equations have in common
            return self._condition(value)
        return self._function(value)

    def _function(self, value: sp.Expr) -> int:
        arguments = [self.write(argument) for argument in value.args]
        if isinstance(value, sp.Min):
            return reduce(lambda a, b: self._emit("LEAST", a, b), arguments)
        if isinstance(value, sp.Max):
            return reduce(lambda a, b: self._emit("LARGEST", a, b), arguments)
        for kind, name in _FUNCTIONS.items():
            if isinstance(value, kind):
                return self._emit(name, arguments[0])
        raise EffectError(
            f"effects: an equation contains {value}, which simulations cannot compute; remove it"
        )

    def _product(self, value: sp.Mul) -> int:
        """Write the factors of the numerator, then one division by the denominator."""
        factors = value.as_ordered_factors()
        below = [f for f in factors if f.is_Pow and f.exp.is_Rational and f.exp.is_negative]
        above = [f for f in factors if f not in below]
        product = self._chain("MULTIPLY", above or [sp.Integer(1)])
        if not below:
            return product
        divisor = self._chain("MULTIPLY", [sp.Pow(f.base, -f.exp) for f in below])
        return self._emit("DIVIDE", product, divisor)

    def _power(self, base: sp.Expr, exponent: sp.Expr) -> int:
        if exponent.is_negative:
            one = self._code.constant(1.0)
            return self._emit("DIVIDE", one, self.write(sp.Pow(base, -exponent)))
        written = self.write(base)
        if exponent == sp.Rational(1, 2):
            return self._emit("ROOT", written)
        if exponent.is_Integer and int(exponent) <= _MOST_MULTIPLICATIONS:
            return self._integer_power(written, int(exponent))
        return self._emit("POW", written, self.write(exponent))

    def _integer_power(self, base: int, exponent: int) -> int:
        """Write an integer power by repeated squaring."""
        result, square = None, base
        while exponent:
            if exponent & 1:
                result = square if result is None else self._emit("MULTIPLY", result, square)
            exponent >>= 1
            if exponent:
                square = self._emit("MULTIPLY", square, square)
        return self._code.constant(1.0) if result is None else result

    def _choice(self, value: sp.Piecewise) -> int:
        """Compute all branches and select one; NaN if no condition holds."""
        chosen = self._code.constant(float("nan"))
        for branch, condition in reversed(value.args):
            written = self.write(branch)
            if condition == sp.true:
                chosen = written
            elif condition != sp.false:
                chosen = self._choose(self._condition(condition), written, chosen)
        return chosen

    def _condition(self, condition: Any) -> int:
        if condition in (sp.true, sp.false):
            return self._code.constant(float(condition == sp.true))
        if condition.is_Symbol:
            return self._registers[condition]
        if isinstance(condition, sp.Not):
            return self._emit("NOT", self._condition(condition.args[0]))
        if isinstance(condition, sp.ITE):
            which, yes, no = (self._condition(each) for each in condition.args)
            where_not = self._emit("AND", self._emit("NOT", which), no)
            return self._emit("OR", self._emit("AND", which, yes), where_not)
        if isinstance(condition, sp.And | sp.Or):
            name = "AND" if isinstance(condition, sp.And) else "OR"
            key: Callable[[Any], Any] = sp.default_sort_key
            written = [self._condition(each) for each in sorted(condition.args, key=key)]
            return reduce(lambda a, b: self._emit(name, a, b), written)
        if type(condition) not in _COMPARISONS:
            raise EffectError(
                f"effects: an equation uses {condition} as a condition, which is not a comparison; "
                "write a comparison such as x > 0"
            )
        name, swapped = _COMPARISONS[type(condition)]
        left, right = (self.write(side) for side in condition.args)
        return self._emit(name, right, left) if swapped else self._emit(name, left, right)

    def _chain(self, operation: str, values: Sequence[sp.Expr]) -> int:
        written = [self.write(value) for value in values]
        return reduce(lambda a, b: self._emit(operation, a, b), written)

    def _emit(self, name: str, a: int, b: int | None = None) -> int:
        """Write an instruction unless its value is already known; return the register."""
        read = [a] if b is None else [a, b]
        piece = ONCE if all(map(self._code.is_fixed, read)) else self._piece
        key = (name, a, 0 if b is None else b, 0)
        if key not in self._known[piece]:
            to = self._code.temporary(fixed=piece == ONCE)
            self._code.pieces[piece].append((name, to, a, 0 if b is None else b))
            self._known[piece][key] = to
        return self._known[piece][key]

    def _choose(self, condition: int, yes: int, no: int) -> int:
        piece = ONCE if all(map(self._code.is_fixed, (condition, yes, no))) else self._piece
        key = ("CHOOSE", condition, yes, no)
        if key not in self._known[piece]:
            to = self._code.temporary(fixed=piece == ONCE)
            self._code.pieces[piece] += [("MOVE", to, no, 0), ("CHOOSE", to, condition, yes)]
            self._known[piece][key] = to
        return self._known[piece][key]
