"""model.h: what the wrapper must know of one model, as constants and tables of C."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from cluster_est.export.repaired_fmu.layout import WrapperLayout
from workers.messages import Value


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
