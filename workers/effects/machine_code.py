"""SymPy equations as compiled C-callable functions: by LLVM's assembly language, else by numba.

numba takes a tenth of a second or two for a function of one line, and a search tries hundreds of
effects once or twice; most of that goes into finding out types, which are known here. These
functions are straight lines of double precision, and LLVM needs a few milliseconds for them. numba
takes what LLVM's language does not know.

References: LLVM Language Reference Manual, https://llvm.org/docs/LangRef.html.
"""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache, reduce
from typing import Any

import llvmlite.binding as llvm
import sympy as sp
from numba import carray, cfunc
from numba.core import types
from numba.core.compiler_lock import global_compiler_lock
from sympy.printing.pycode import pycode

_LIBRARY_FUNCTIONS: dict[type[sp.Function], str] = {
    sp.exp: "exp",
    sp.log: "log",
    sp.sin: "sin",
    sp.cos: "cos",
    sp.tan: "tan",
    sp.tanh: "tanh",
    sp.atan: "atan",
}
"""Functions of the C library, by address."""
_LLVM_COMPARISONS: dict[type[sp.core.relational.Relational], str] = {
    sp.StrictLessThan: "olt",
    sp.LessThan: "ole",
    sp.StrictGreaterThan: "ogt",
    sp.GreaterThan: "oge",
    sp.Equality: "oeq",
    sp.Unequality: "une",
}
_LARGEST_POWER_AS_PRODUCT = 64
"""Integer powers up to this one are products."""
_INTRINSICS = """
declare double @llvm.fabs.f64(double)
declare double @llvm.sqrt.f64(double)
declare double @llvm.copysign.f64(double, double)
"""


class UntranslatableError(Exception):
    """An expression, or a machine, that another compiler must see to."""


@dataclass(frozen=True)
class MachineCode:
    """A compiled function; the code lives as long as this."""

    address: int
    engine: Any = field(repr=False)


class Assembly:
    """The body of a function in LLVM's assembly language, written line by line.

    Values are written as they stand in an instruction: a register or a constant.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._values: dict[sp.Symbol, str] = {}

    def load(self, array: str, index: int) -> str:
        """Read an element of an array of doubles."""
        return self._assign(f"load double, ptr {self._element(array, index)}")

    def store(self, array: str, index: int, value: str) -> None:
        """Write an element of an array of doubles."""
        self.lines.append(f"store double {value}, ptr {self._element(array, index)}")

    def define(self, symbol: sp.Symbol, value: str) -> None:
        """Let a symbol stand for a value from now on."""
        self._values[symbol] = value

    def add(self, one: str, other: str) -> str:
        """Add two values."""
        return self._assign(f"fadd double {one}, {other}")

    def write(self, value: sp.Expr) -> str:
        """Write the instructions for an expression, and return its value.

        Raises
        ------
        UntranslatableError
            If it has something in it that is not known here.
        """
        if value.is_Symbol:
            return self._values[value]
        if value.is_number:
            return _constant(float(value))
        if isinstance(value, sp.Add):
            return self._chain("fadd", value.as_ordered_terms())
        if isinstance(value, sp.Mul):
            return self._product(value)
        if isinstance(value, sp.Pow):
            return self._power(value.base, value.exp)
        if isinstance(value, sp.Piecewise):
            return self._choice(value)
        return self._function(value)

    def _function(self, value: sp.Expr) -> str:
        arguments = [self.write(argument) for argument in value.args]
        if isinstance(value, sp.Abs):
            return self._assign(f"call double @llvm.fabs.f64(double {arguments[0]})")
        if isinstance(value, sp.sign):
            return self._sign(arguments[0])
        if isinstance(value, sp.Min):
            return reduce(lambda a, b: self._less(b, a, b, a), arguments)
        if isinstance(value, sp.Max):
            return reduce(lambda a, b: self._less(a, b, b, a), arguments)
        name = _LIBRARY_FUNCTIONS.get(type(value))
        if name is None:
            raise UntranslatableError(f"{type(value).__name__} is not known")
        return self._call(name, arguments)

    def _product(self, value: sp.Mul) -> str:
        """Write the factors, then one division by what stands below the line."""
        factors = value.as_ordered_factors()
        below = [f for f in factors if f.is_Pow and f.exp.is_Rational and f.exp.is_negative]
        above = [f for f in factors if f not in below]
        product = self._chain("fmul", above or [sp.Integer(1)])
        if not below:
            return product
        divisor = self._chain("fmul", [sp.Pow(f.base, -f.exp) for f in below])
        return self._assign(f"fdiv double {product}, {divisor}")

    def _power(self, base: sp.Expr, exponent: sp.Expr) -> str:
        if exponent.is_negative:
            return self._assign(
                f"fdiv double {_constant(1.0)}, {self.write(sp.Pow(base, -exponent))}"
            )
        written = self.write(base)
        if exponent == sp.Rational(1, 2):
            return self._assign(f"call double @llvm.sqrt.f64(double {written})")
        if exponent.is_Integer and int(exponent) <= _LARGEST_POWER_AS_PRODUCT:
            return self._integer_power(written, int(exponent))
        return self._call("pow", [written, self.write(exponent)])

    def _integer_power(self, base: str, exponent: int) -> str:
        """Multiply by repeated squaring."""
        result, square = "", base
        while exponent:
            if exponent & 1:
                result = self._assign(f"fmul double {result}, {square}") if result else square
            exponent >>= 1
            if exponent:
                square = self._assign(f"fmul double {square}, {square}")
        return result

    def _choice(self, value: sp.Piecewise) -> str:
        """Compute all branches and choose; without one that always holds, not a number."""
        chosen = _constant(float("nan"))
        for branch, condition in reversed(value.args):
            written = self.write(branch)
            holds = self._condition(condition)
            chosen = self._assign(f"select i1 {holds}, double {written}, double {chosen}")
        return chosen

    def _condition(self, condition: Any) -> str:
        if condition in (sp.true, sp.false):
            return "true" if condition == sp.true else "false"
        if isinstance(condition, sp.Not):
            return self._assign(f"xor i1 {self._condition(condition.args[0])}, true")
        if isinstance(condition, sp.And | sp.Or):
            operation = "and" if isinstance(condition, sp.And) else "or"
            written = [self._condition(each) for each in _ordered(condition.args)]
            return reduce(lambda a, b: self._assign(f"{operation} i1 {a}, {b}"), written)
        comparison = _LLVM_COMPARISONS.get(type(condition))
        if comparison is None:
            raise UntranslatableError(f"{type(condition).__name__} is not known")
        left, right = (self.write(side) for side in condition.args)
        return self._assign(f"fcmp {comparison} double {left}, {right}")

    def _sign(self, value: str) -> str:
        one = f"call double @llvm.copysign.f64(double {_constant(1.0)}, double {value})"
        nought = self._assign(f"fcmp oeq double {value}, {_constant(0.0)}")
        signed = self._assign(one)
        return self._assign(f"select i1 {nought}, double {_constant(0.0)}, double {signed}")

    def _less(self, a: str, b: str, yes: str, no: str) -> str:
        less = self._assign(f"fcmp olt double {a}, {b}")
        return self._assign(f"select i1 {less}, double {yes}, double {no}")

    def _chain(self, operation: str, values: Sequence[sp.Expr]) -> str:
        written = [self.write(value) for value in values]
        return reduce(lambda a, b: self._assign(f"{operation} double {a}, {b}"), written)

    def _call(self, name: str, arguments: Sequence[str]) -> str:
        given = ", ".join(f"double {argument}" for argument in arguments)
        return self._assign(f"call double inttoptr (i64 {_address(name)} to ptr)({given})")

    def _element(self, array: str, index: int) -> str:
        return self._assign(f"getelementptr double, ptr %{array}, i64 {index}")

    def _assign(self, instruction: str) -> str:
        register = f"%v{len(self.lines)}"
        self.lines.append(f"{register} = {instruction}")
        return register


def assemble(arrays: Sequence[str], body: Assembly) -> MachineCode:
    """Make a function ``int f(double t, double *a, double *b, ...)`` of a body, which returns 0.

    Raises
    ------
    UntranslatableError
        If this machine's LLVM does not take it.
    """
    arguments = ", ".join(["double %t", *(f"ptr noalias %{array}" for array in arrays)])
    lines = "\n  ".join([*body.lines, "ret i32 0"])
    text = f"{_INTRINSICS}\ndefine i32 @effect({arguments}) {{\n  {lines}\n}}\n"
    with global_compiler_lock:
        try:
            module = llvm.parse_assembly(text)
            module.verify()
            machine = _target().create_target_machine(opt=2, codemodel="jitdefault", jit=True)
            engine = llvm.create_mcjit_compiler(module, machine)  # which owns both from now on
            engine.finalize_object()
        except RuntimeError as error:
            raise UntranslatableError(str(error)) from error
        return MachineCode(engine.get_function_address("effect"), engine)


@cache
def _target() -> Any:
    """Make LLVM ready for this machine."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_triple(llvm.get_process_triple())


@cache
def _address(name: str) -> int:
    """Return the address of a function of the C library."""
    for library in _c_libraries():
        function = getattr(library, name, None)
        if function is not None:
            return int(ctypes.cast(function, ctypes.c_void_p).value or 0)
    raise UntranslatableError(f"the C library of this process has no {name}")


@cache
def _c_libraries() -> tuple[ctypes.CDLL, ...]:
    """Where the C library's mathematics may be: what Python is linked with, and its own file."""
    names = ["ucrtbase"] if sys.platform == "win32" else [None, ctypes.util.find_library("m")]
    found = []
    for name in dict.fromkeys(names):
        with contextlib.suppress(OSError):
            found.append(ctypes.CDLL(name))
    return tuple(found)


def _constant(value: float) -> str:
    """Return a double as LLVM writes it, bit by bit."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"


def _ordered(conditions: Sequence[Any]) -> list[Any]:
    """Return conditions in an order that is always the same."""
    key: Callable[[Any], Any] = sp.default_sort_key
    return sorted(conditions, key=key)


class EffectArray(StrEnum):
    """Arrays that equations of effects read and write, by their names in the C of exported FMUs."""

    STATES = "states"
    INPUTS = "raw"
    COEFFICIENTS = "coefficients"
    BASE = "base"
    EFFECTIVE_INPUTS = "edited"
    EFFECTIVE_PARAMETERS = "varied"
    DERIVATIVES = "slopes"
    OUTPUTS = "row"
    RESULT = "result"
    FASTEST = "fastest"


@dataclass(frozen=True)
class CAssignment:
    """`target[index] = value`, or `+=`."""

    target: EffectArray
    index: int
    value: sp.Expr
    add: bool = False


SymbolLocations = dict[sp.Symbol, tuple[EffectArray, int]]
"""(array, index) of each symbol."""


def compile_function(
    arrays: Sequence[EffectArray],
    locations: SymbolLocations,
    assignments: Sequence[CAssignment],
    time: sp.Symbol,
) -> Any:
    """Compile assignments to a C function ``int f(double t, double *a, double *b, ...)``.

    Parameters
    ----------
    arrays
        Names of the pointer arguments, in order.
    locations
        (array, index) of each symbol of the equations.
    assignments
        Statements of the function. All values are read before anything is written.
    time
        The symbol of the first argument.

    Returns
    -------
    MachineCode or numba cfunc
        Its `address` is what compiled loops call. Keep it: the code lives as long as the object.
    """
    equations = _PreparedEquations.of(assignments, locations, time)
    try:
        return assemble(arrays, _body(equations, assignments))
    except UntranslatableError:
        text = _source(arrays, locations, equations, assignments)
    scope: dict[str, Any] = {"carray": carray, "math": __import__("math")}
    exec(compile(text, "<effect>", "exec"), scope)  # printed by SymPy from a checked syntax tree
    pointers = [types.CPointer(types.float64)] * len(arrays)  # type: ignore[attr-defined]
    return cfunc(types.int32(types.float64, *pointers), error_model="numpy")(scope["effect"])


_TIME_ARGUMENT = sp.Symbol("t", real=True)


@dataclass(frozen=True)
class _PreparedEquations:
    """Equations over symbols of short names, by which sums and products are ordered.

    Attributes
    ----------
    read
        Each symbol but the time, and the place of its value.
    common
        Parts that are computed once, in this order.
    values
        The equations, with the symbols of these parts in them.
    """

    read: tuple[tuple[sp.Symbol, tuple[EffectArray, int]], ...]
    common: tuple[tuple[sp.Symbol, sp.Expr], ...]
    values: tuple[sp.Expr, ...]

    @classmethod
    def of(
        cls, assignments: Sequence[CAssignment], locations: SymbolLocations, time: sp.Symbol
    ) -> _PreparedEquations:
        used = set().union(*(a.value.free_symbols for a in assignments)) if assignments else set()
        ordered = sorted(used - {time}, key=str)
        short = {symbol: sp.Symbol(f"s{i}", real=True) for i, symbol in enumerate(ordered)}
        values = [a.value.xreplace(short | {time: _TIME_ARGUMENT}) for a in assignments]
        common, reduced = sp.cse(values, symbols=sp.numbered_symbols("c"))
        read = tuple((local, locations[symbol]) for symbol, local in short.items())
        return cls(read, tuple(common), tuple(reduced))


def _body(equations: _PreparedEquations, assignments: Sequence[CAssignment]) -> Assembly:
    """Return the function in LLVM's language."""
    body = Assembly()
    body.define(_TIME_ARGUMENT, "%t")
    for local, location in equations.read:
        body.define(local, body.load(*location))
    for symbol, value in equations.common:
        body.define(symbol, body.write(value))
    results = [body.write(value) for value in equations.values]
    for assignment, result in zip(assignments, results, strict=True):
        if assignment.add:
            result = body.add(body.load(assignment.target, assignment.index), result)
        body.store(assignment.target, assignment.index, result)
    return body


def _source(
    arrays: Sequence[EffectArray],
    locations: SymbolLocations,
    equations: _PreparedEquations,
    assignments: Sequence[CAssignment],
) -> str:
    """Return the function as Python text, with common parts computed once."""
    sizes = dict.fromkeys(arrays, 1)
    for array, index in [*locations.values(), *((a.target, a.index) for a in assignments)]:
        sizes[array] = max(sizes[array], index + 1)
    lines = [f"{name} = carray({name}_, {size})" for name, size in sizes.items()]
    lines += [f"{local} = {array}[{index}]" for local, (array, index) in equations.read]
    lines += [f"{symbol} = {_print(value)}" for symbol, value in equations.common]
    lines += [f"r{i} = {_print(value)}" for i, value in enumerate(equations.values)]
    for i, assignment in enumerate(assignments):
        lines.append(
            f"{assignment.target}[{assignment.index}] {'+=' if assignment.add else '='} r{i}"
        )
    header = ", ".join(f"{name}_" for name in arrays)
    return "\n    ".join([f"def effect(t, {header}):", *lines, "return 0"]) + "\n"


def _print(value: sp.Expr) -> str:
    """Return the Python text of an expression, a power of a half as a square root."""
    return str(pycode(value, fully_qualified_modules=True))
