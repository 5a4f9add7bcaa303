"""Effects as C: the same equations that a run compiles, printed by SymPy."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import sympy as sp
from sympy.printing.c import C99CodePrinter

from cluster_est.model_export.wrapper_layout import WrapperLayout
from workers.core.assemble import Assignment, EffectArray, Locations
from workers.effects.definition import (
    SIGNAL_SYMBOL,
    TIME_SYMBOL,
    EffectDefinition,
    known_decay,
    known_rates,
    variable_symbol,
)
from workers.effects.expression import Max
from workers.messages import Value


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


def _function(header: str, locations: Locations, assignments: Sequence[Assignment]) -> str:
    return f"{header} {{\n{_unused(header)}{_body(locations, assignments)}}}"


def _unused(header: str) -> str:
    """Not every equation uses every argument; compilers are told so."""
    return "".join(f"    (void){name};\n" for name in re.findall(r"(\w+)[,)]", header))


def _body(locations: Locations, assignments: Sequence[Assignment], indent: str = "    ") -> str:
    """Statements: the symbols that are used, common parts, and what is assigned in the end."""
    used = set().union(*(a.value.free_symbols for a in assignments)) if assignments else set()
    meaning: dict[sp.Symbol, sp.Symbol] = {TIME_SYMBOL: sp.Symbol("t", real=True)}
    lines = []
    for number, symbol in enumerate(sorted(used - {TIME_SYMBOL}, key=str)):
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
    fastest = Assignment("fastest", -1, Max(sp.Integer(0), *rates))
    head = "double effects_rate(const double *coefficients)"
    body = _body(layout.equations.locations, [fastest])
    return f"{head} {{\n    double fastest;\n{_unused(head)}{body}    return fastest;\n}}"


@dataclass(frozen=True)
class _OutputFunction:
    """A C function over all effects at outputs: its head, and what it assigns for one of them.

    `assign` takes the effect and the index of its first own state.
    """

    head: str
    assign: Callable[[EffectDefinition, int], list[Assignment]]
    returns: bool


_ROW = "const double *row, const double *raw, const double *coefficients"
_OUTPUT_FUNCTIONS = (
    _OutputFunction(
        f"void output_begin(int e, double t, double *states, {_ROW})",
        lambda effect, first: [
            Assignment(EffectArray.STATES, first + i, e) for i, e in enumerate(effect.starts)
        ],
        returns=False,
    ),
    _OutputFunction(
        f"void output_inside(int e, double t, const double *states, {_ROW}, double *slopes)",
        lambda effect, first: [
            Assignment(EffectArray.DERIVATIVES, first + i, e)
            for i, e in enumerate(effect.derivatives)
        ],
        returns=False,
    ),
    _OutputFunction(
        f"double output_after(int e, double t, const double *states, {_ROW})",
        lambda effect, _: [Assignment(EffectArray.RESULT, -1, effect.equations[0][1])],
        returns=True,
    ),
    _OutputFunction(
        f"double output_rate(int e, {_ROW})",
        lambda effect, _: [Assignment(EffectArray.RESULT, -1, _fastest(effect))],
        returns=True,
    ),
    _OutputFunction(
        f"double output_decay(int e, {_ROW})",
        lambda effect, _: [Assignment(EffectArray.RESULT, -1, known_decay(effect))],
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
) -> Locations:
    locations: Locations = {
        variable_symbol(name): (EffectArray.INPUTS, i) for i, name in enumerate(layout.columns)
    }
    locations |= {
        variable_symbol(name): (EffectArray.OUTPUTS, i) for i, name in enumerate(layout.row)
    }
    locations[SIGNAL_SYMBOL] = (EffectArray.OUTPUTS, layout.row.index(definition.site.target))
    locations |= {
        s: (EffectArray.COEFFICIENTS, position + i) for i, s in enumerate(definition.coefficients)
    }
    return locations


def header(layout: WrapperLayout, guid: str) -> str:
    """The text of model.h."""
    lines = ["/* Written for one run; see documentation/README.md. */", "#ifndef MODEL_H"]
    lines += ["#define MODEL_H", "", "#include <math.h>", ""]
    found = {**_identity(layout, guid), **_counts(layout), **_solver(layout), **_tables(layout)}
    found |= _others(layout) | _translated(layout)
    lines += [f"#define {name} {value}" for name, value in found.items()]
    return "\n".join([*lines, "", "#endif", ""])


def _identity(layout: WrapperLayout, guid: str) -> dict[str, object]:
    model, description = layout.repair.problem.model, layout.repair.description
    return {
        "MODEL_GUID": _text(guid),
        "ORIGINAL_GUID": _text(description.guid),
        "ORIGINAL_IDENTIFIER": _text(description.offer(model.interface).identifier),
        "ORIGINAL_FMI": int(description.version == "3.0") + 2,
        "ORIGINAL_EXCHANGE": int(layout.exchange),
    }


def _counts(layout: WrapperLayout) -> dict[str, object]:
    repair, equations = layout.repair, layout.equations
    description = repair.description
    return {
        "N_STATES": len(layout.states),
        "N_OWN": len(equations.start_states),
        "N_OUTPUT_OWN": sum(len(layout.effect(i).states) for i in layout.outputs),
        "N_INDICATORS": description.event_indicators if layout.exchange else 0,
        "N_INPUTS": len(layout.inputs),
        "N_MOVING": layout.n_continuous,
        "N_SIGNALS": len(layout.signals),
        "N_COEFFICIENTS": sum(map(len, repair.coefficients)),
        "N_BASE": len(equations.parameters),
        "N_STARTS": len(layout.starts),
        "N_ROW": len(layout.row),
        "N_INPUT_MEMORIES": len(layout.memories),
        "N_OUTPUT_EFFECTS": len(layout.outputs),
        "N_SPECIALS": len(layout.answered),
        "N_TOUCHED": len(layout.affected),
        "HAS_BEFORE": int(bool(equations.modify_inputs)),
        "TOUCHES_EXCHANGE": int(bool(repair.effects)),
    }


def _solver(layout: WrapperLayout) -> dict[str, object]:
    model, description = layout.repair.problem.model, layout.repair.description
    solver = model.solver
    eventful = description.event_indicators > 0 or any(
        v.variability == "discrete" for v in description.variables.values()
    )
    return {
        "FIXED_STEPS": int(solver.name == "rk4"),
        "SOLVER_STEP": _number(solver.step or 0.0),
        "SOLVER_RTOL": _number(layout.tolerance),
        "SOLVER_ATOL": _number(layout.tolerance if solver.atol is None else solver.atol),
        "MOST_STEPS": f"{solver.max_steps}L",
        "ORIGINAL_TOLERANCE": _number(solver.rtol or 0.0),
        "COMPLETES_STEPS": int(layout.exchange and description.completes_steps),
        "INTERPOLATES": int(description.interpolates_inputs),
        "EVENTFUL": int(eventful),
    }


def _tables(layout: WrapperLayout) -> dict[str, object]:
    repair, variables = layout.repair, layout.repair.description.variables
    nominals = [variables[name].nominal for name in layout.states]
    nominals += [1.0] * len(layout.equations.start_states)
    found = {f.name: f.value for f in (*repair.parameters,)} | {
        name: float(value) for name, value in repair.known if isinstance(value, float | int)
    }
    bases = [found.get(n, variables[n].start or 0.0) for n in layout.equations.parameters]
    raw = [found.get(v.name, v.start or 0.0) for v in layout.inputs] + [0.0] * len(layout.signals)
    references = {
        "INPUT": [v.reference for v in layout.inputs],
        "BASE": [layout.reference(n) for n in layout.equations.parameters],
        "START": [layout.reference(f.name) for f in layout.starts],
        "ROW": [layout.reference(n) for n in layout.row],
        "TOUCHED": layout.affected,
        "RAW": [
            *(v.reference for v in layout.inputs),
            *(own.reference for own in layout.added if own.kind == "SIGNAL"),
        ],
    }
    tables: dict[str, object] = {
        f"{name}_REFERENCES": _list(map(str, each)) for name, each in references.items()
    }
    return tables | {
        "COEFFICIENTS": _list(_number(f.value) for own in repair.coefficients for f in own),
        "STARTS": _list(_number(f.value) for f in layout.starts),
        "BASES": _list(map(_number, bases)),
        "RAW_STARTS": _list(map(_number, raw)),
        "NOMINALS": _list(map(_number, nominals)),
        "INPUT_MEMORIES": _list(_memory(layout, i) for i in layout.memories),
        "OUTPUT_EFFECTS": _list(_output_effect(layout, i) for i in layout.outputs),
        "SPECIALS": _list(
            f"{{{s.reference}, {s.kind}, {s.index}, {s.start}}}" for s in layout.answered
        ),
    }


def _others(layout: WrapperLayout) -> dict[str, object]:
    """Values of the run that are no reals, but structural parameters, which come first."""
    variables = layout.repair.description.variables
    found: dict[str, object] = {}
    for kind, written in _WRITTEN.items():
        known = [(variables[name], value) for name, value in layout.repair.known]
        known = [(v, value) for v, value in known if v.kind == kind]
        known = [(v, value) for v, value in known if v.causality != "structuralParameter"]
        found[f"N_{kind.upper()}S"] = len(known)
        found[f"{kind.upper()}_REFERENCES"] = _list(str(v.reference) for v, _ in known)
        found[f"{kind.upper()}S"] = _list(written(value) for _, value in known)
    return found


def _translated(layout: WrapperLayout) -> dict[str, object]:
    """Return tables of the variables of FMI 3.0 that FMI 2.0 has another form for."""
    variables = layout.repair.description.variables
    rows, elements = [], list[float]()
    for variable in layout.translated:
        kept = len(elements) if variable.starts else -1
        called = "Int64" if variable.type == "Enumeration" else variable.type
        rows.append(
            f"{{{variable.first}, {variable.size}, {called}, {variable.reference}, {kept}}}"
        )
        elements += variable.starts
    sizes = layout.repair.problem.model.structure
    return {
        "N_PLACES": len(rows),
        "N_ELEMENTS": len(elements),
        "N_STRUCTURE": len(sizes),
        "LARGEST": max((variable.size for variable in layout.translated), default=1),
        "PLACES": _list(rows or ["{0}"]),
        "ELEMENTS": _list(map(_number, elements)),
        "STRUCTURE": _list([f"{{{variables[n].reference}, {v}}}" for n, v in sizes] or ["{0}"]),
    }


def _memory(layout: WrapperLayout, index: int) -> str:
    effect = layout.effect(index)
    column = layout.columns.index(effect.site.target)
    return f"{{{effect.form.memory.upper()}, {column}, {layout.repair.positions[index]}}}"


def _output_effect(layout: WrapperLayout, index: int) -> str:
    effect = layout.effect(index)
    column = layout.row.index(effect.site.target)
    delay = layout.repair.positions[index] if effect.form.memory else -1
    first = layout.first_output_state(index)
    return f"{{{column}, {delay}, {first}, {len(effect.states)}}}"


def _number(value: float) -> str:
    if value in (float("inf"), float("-inf")):
        return "HUGE_VAL" if value > 0.0 else "-HUGE_VAL"
    return repr(float(value))


def _list(items: Iterable[str]) -> str:
    """An initialiser, which C wants to have an element at least."""
    return "{" + (", ".join(items) or "0") + "}"


def _text(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'


_WRITTEN: dict[str, Callable[[Value], str]] = {
    "integer": lambda value: str(int(value)),
    "boolean": lambda value: str(int(bool(value))),
    "string": lambda value: _text(str(value)),
}
"""Values of each kind in C."""
