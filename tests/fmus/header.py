"""The variables of a test model as a C header."""

from __future__ import annotations

from collections.abc import Iterable
from math import prod
from typing import Any

from fmus.variables import Model, Variable


def header(model: Model) -> str:
    """Return ``model_variables.h``, which tells the scaffold and the equations the variables."""
    spec, variables = model.spec, model.variables
    pairs = zip(model.states, model.derivatives, strict=True)
    states = [
        f"{{{x.reference}, {dx.reference}, {float(x.spec.get('nominal', 1.0))!r}}}"
        for x, dx in pairs
    ]
    indicators = [str(v.reference) for v in model.indicators]
    largest = sum(capacity(model, v) for v in model.states)
    fields = [f"    {v.type} {v.identifier}{bracket(model, v)};" for v in variables]
    starts = (f".{v.identifier} = {start(v)}" for v in variables if "start" in v.spec)
    structural = any(v.causality == "structuralParameter" for v in variables)
    return "\n".join(
        [
            "/* Generated from model.toml. */",
            f'#define MODEL_NAME "{model.name}"',
            f'#define MODEL_TOKEN "{model.token}"',
            f"#define MAX_STEP {float(spec.get('max_step', 0.01))!r}",
            f"#define FIXED_STEP {float(spec.get('fixed_step', 0.0))!r}",
            f"#define DIRECTIONAL {int(spec.get('directional', False))}",
            f"#define STRUCTURAL {int(structural)}",
            f"enum {braces([*(f'V_{v.identifier}' for v in variables), 'N_VARIABLES'])};",
            f"enum {{ N_INDICATORS = {len(indicators)}, MAX_STATES = {max(largest, 1)} }};",
            *("typedef struct {", *fields, "} Values;"),
            f"#define VARIABLES {braces(row(model, v) for v in variables)}",
            f"#define STATES {braces([*states, '{-1, -1, 0.0}'])}",
            f"#define INDICATORS {braces([*indicators, '-1'])}",
            f"#define START_VALUES {braces(['.time = 0.0', *starts])}",
            "",
        ]
    )


def braces(items: Iterable[str]) -> str:
    return "{" + ", ".join(items) + "}"


def capacity(model: Model, variable: Variable) -> int:
    """The most elements that a variable can have."""
    sizes = [model.by_name[d].spec["max"] if isinstance(d, str) else d for d in variable.dimensions]
    return prod(sizes)


def bracket(model: Model, variable: Variable) -> str:
    return f"[{capacity(model, variable)}]" if variable.dimensions else ""


def start(variable: Variable) -> str:
    """The start value as a C initialiser."""
    value = variable.spec["start"]
    if isinstance(value, list):
        return braces(literal(variable, v) for v in value)
    return literal(variable, value)


def literal(variable: Variable, value: Any) -> str:
    if variable.type == "Binary":
        content = bytes.fromhex(value)
        return f"{{{len(content)}, {braces(str(b) for b in content)}}}"
    if variable.type == "String":
        return f'"{value}"'
    if variable.type == "Int64":
        return f"INT64_C({value})"
    if variable.type == "UInt64":
        return f"UINT64_C({value})"
    return str(value).lower()


def row(model: Model, variable: Variable) -> str:
    """One line of the scaffold's table."""
    named = [d for d in variable.dimensions if isinstance(d, str)]
    sized_by = model.by_name[named[0]].reference if named else -1
    cells = [
        f'"{variable.name}"',
        variable.type.upper(),
        f"offsetof(Values, {variable.identifier})",
        f"sizeof({variable.type})",
        str(capacity(model, variable)),
        str(sized_by),
        variable.settable,
        str(int(variable.initial == "calculated")),
    ]
    return braces(cells)
