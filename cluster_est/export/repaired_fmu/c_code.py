"""Effects as C: the same equations that a run compiles, printed by SymPy."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import sympy as sp
from sympy.printing.c import C99CodePrinter

from cluster_est.export.repaired_fmu.layout import WrapperLayout
from workers.effects.definition import (
    SIGNAL,
    TIME,
    EffectDefinition,
    known_decay,
    known_rates,
    variable_symbol,
)
from workers.effects.plain_functions import Max
from workers.effects.source import CAssignment, EffectArray, SymbolLocations


class _CPrinter(C99CodePrinter):  # type: ignore[misc]
    """C99; small powers are products, as compilers make them of what a run compiles."""

    def _print_Pow(self, expr: sp.Expr) -> str:  # noqa: N802 - SymPy's name
        base, exponent = expr.args
        if exponent in (2, 3, 4):
            return "(" + "*".join([f"({self._print(base)})"] * int(exponent)) + ")"
        return str(super()._print_Pow(expr))

    def _print_sign(self, expr: sp.Expr) -> str:
        value = self._print(expr.args[0])
        return f"((double)(({value} > 0.0) - ({value} < 0.0)))"


def effects_source(layout: WrapperLayout) -> str:
    """The file effects.c."""
    equations = layout.equations
    begin = "void effects_begin(double t, double *states, const double *raw, "
    begin += "const double *coefficients, const double *base)"
    read = "double t, const double *states, const double *raw, const double *coefficients, "
    read += "const double *base"
    parts = [
        "/* Printed from the effects of the run; see documentation/README.md. */",
        '#include "effects.h"\n\n#include <math.h>',
        _function(begin, equations.locations, equations.start_states),
        _function(
            f"void effects_before({read}, double *edited, double *varied)",
            equations.locations,
            equations.modify_inputs,
        ),
        _function(
            f"void effects_inside({read}, double *slopes)",
            equations.locations,
            equations.add_derivatives,
        ),
        _inner_rate(layout),
        *(_output(layout, function) for function in _OUTPUT_FUNCTIONS),
    ]
    return "\n\n".join(parts) + "\n"


def _function(header: str, locations: SymbolLocations, assignments: Sequence[CAssignment]) -> str:
    return f"{header} {{\n{_unused(header)}{_body(locations, assignments)}}}"


def _unused(header: str) -> str:
    """Not every equation uses every argument; compilers are told so."""
    return "".join(f"    (void){name};\n" for name in re.findall(r"(\w+)[,)]", header))


def _body(
    locations: SymbolLocations, assignments: Sequence[CAssignment], indent: str = "    "
) -> str:
    """Statements: the symbols that are used, common parts, and what is assigned in the end."""
    used = set().union(*(a.value.free_symbols for a in assignments)) if assignments else set()
    meaning: dict[sp.Symbol, sp.Symbol] = {TIME: sp.Symbol("t", real=True)}
    lines = []
    for number, symbol in enumerate(sorted(used - {TIME}, key=str)):
        array, index = locations[symbol]
        meaning[symbol] = sp.Symbol(f"s{number}", real=True)
        lines.append(f"const double s{number} = {array}[{index}]; /* {_comment(symbol)} */")
    values = [a.value.xreplace(meaning) for a in assignments]
    common, reduced = sp.cse(values, symbols=sp.numbered_symbols("c"))
    lines += [f"const {_type(v)} {symbol} = {_inline(v)};" for symbol, v in common]
    lines += [f"const double r{i} = {_inline(value)};" for i, value in enumerate(reduced)]
    for i, a in enumerate(assignments):
        target = f"{a.target}[{a.index}]" if a.index >= 0 else a.target
        lines.append(f"{target} {'+=' if a.add else '='} r{i};")
    return "".join(f"{indent}{line}\n" for line in lines)


def _type(value: sp.Basic) -> str:
    return "int" if isinstance(value, sp.logic.boolalg.Boolean) else "double"


def _comment(symbol: sp.Symbol) -> str:
    name = str(symbol).removeprefix("fmu:").removeprefix("base:")
    return re.sub(r"[/*\\\n]+", " ", name)


def _inline(value: sp.Expr) -> str:
    return " ".join(_CPrinter().doprint(value).split())


def _inner_rate(layout: WrapperLayout) -> str:
    """The fastest rate of own states, as far as it depends on coefficients alone."""
    rates = [abs(rate) for i in layout.inner for rate in known_rates(layout.effect(i), ())]
    fastest = CAssignment(EffectArray.FASTEST, -1, Max(sp.Integer(0), *rates))
    head = "double effects_rate(const double *coefficients)"
    body = _body(layout.equations.locations, [fastest])
    return f"{head} {{\n    double fastest;\n{_unused(head)}{body}    return fastest;\n}}"


@dataclass(frozen=True)
class _OutputFunction:
    """A C function over all effects at outputs: its head, and what it assigns for one of them.

    `assign` takes the effect and the index of its first own state.
    """

    head: str
    assign: Callable[[EffectDefinition, int], list[CAssignment]]
    returns: bool


_ROW = "const double *row, const double *raw, const double *coefficients"
_OUTPUT_FUNCTIONS = (
    _OutputFunction(
        f"void output_begin(int e, double t, double *states, {_ROW})",
        lambda effect, first: [
            CAssignment(EffectArray.STATES, first + i, e) for i, e in enumerate(effect.starts)
        ],
        returns=False,
    ),
    _OutputFunction(
        f"void output_inside(int e, double t, const double *states, {_ROW}, double *slopes)",
        lambda effect, first: [
            CAssignment(EffectArray.DERIVATIVES, first + i, e)
            for i, e in enumerate(effect.derivatives)
        ],
        returns=False,
    ),
    _OutputFunction(
        f"double output_after(int e, double t, const double *states, {_ROW})",
        lambda effect, _: [CAssignment(EffectArray.RESULT, -1, effect.equations[0][1])],
        returns=True,
    ),
    _OutputFunction(
        f"double output_rate(int e, {_ROW})",
        lambda effect, _: [CAssignment(EffectArray.RESULT, -1, _fastest(effect))],
        returns=True,
    ),
    _OutputFunction(
        f"double output_decay(int e, {_ROW})",
        lambda effect, _: [CAssignment(EffectArray.RESULT, -1, known_decay(effect))],
        returns=True,
    ),
)


def _fastest(effect: EffectDefinition) -> sp.Expr:
    """Return the fastest rate of its own states."""
    rates = [abs(rate) for rate in known_rates(effect, effect.uses)]
    return Max(sp.Integer(0), *rates)


def _output(layout: WrapperLayout, function: _OutputFunction) -> str:
    """Return a function that chooses one of the effects at outputs by its number."""
    arms = ""
    for number, i in enumerate(layout.outputs):
        effect, first = layout.effect(i), layout.first_output_state(i)
        locations = _output_locations(layout, effect, layout.repair.positions[i])
        locations |= {s: (EffectArray.STATES, first + n) for n, s in enumerate(effect.states)}
        body = _body(locations, function.assign(effect, first), " " * 12)
        arms += f"        case {number}: {{\n{body}            break;\n        }}\n"
    declared = "    double result = 0.0;\n" if function.returns else ""
    last = "    return result;\n" if function.returns else ""
    choice = f"    switch (e) {{\n{arms}        default:\n            break;\n    }}\n"
    return f"{function.head} {{\n{declared}{_unused(function.head)}{choice}{last}}}"


def _output_locations(
    layout: WrapperLayout, definition: EffectDefinition, position: int
) -> SymbolLocations:
    locations: SymbolLocations = {
        variable_symbol(name): (EffectArray.INPUTS, i) for i, name in enumerate(layout.columns)
    }
    locations |= {
        variable_symbol(name): (EffectArray.OUTPUTS, i) for i, name in enumerate(layout.row)
    }
    locations[SIGNAL] = (EffectArray.OUTPUTS, layout.row.index(definition.site.target))
    locations |= {
        s: (EffectArray.COEFFICIENTS, position + i) for i, s in enumerate(definition.coefficients)
    }
    return locations
