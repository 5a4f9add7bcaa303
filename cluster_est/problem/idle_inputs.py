"""Inputs of an FMU that nothing drives, and so keep their start values."""

from __future__ import annotations

from cluster_est.problem.problem import Problem
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable

MOST_NAMED = 4
"""Inputs in a note."""


def idle_inputs(problem: Problem, description: ModelDescription) -> dict[str, list[str]]:
    """Return the inputs of the FMU that nothing drives, with the experiments in which."""
    targets = {p.target for p in problem.parameters if not p.auxiliary}
    found: dict[str, list[str]] = {}
    for variable in description.inputs():
        names = {variable.name, *variable.aliases}
        if variable.kind not in ("real", "integer", "boolean") or names & targets:
            continue
        for each in problem.experiments:
            if names.isdisjoint({i.variable for i in each.inputs} | dict(each.values).keys()):
                found.setdefault(variable.name, []).append(each.id)
    return found


def stays(variable: ModelVariable) -> str:
    """Return the value of an input that nothing drives, with its unit."""
    return f"{variable.start or 0.0:g} {variable.unit}".strip()


def driven_or_constant(name: str) -> str:
    """Return the two keys of which one says what an input is."""
    data, constant = dotted("inputs", name), dotted("values", name)
    return f'{data} = "COLUMN", or {constant} = NUMBER if it is constant'


def silent_inputs(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    """Return the inputs that nothing drives in any experiment."""
    idle, count = idle_inputs(problem, description), len(problem.experiments)
    return tuple(name for name, ids in idle.items() if len(ids) == count)


def silent_notes(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    """Say which inputs nothing drives; nothing where all are driven."""
    names = silent_inputs(problem, description)
    if not names:
        return ()
    named = [f"{n} ({stays(description.variables[n])})" for n in names[:MOST_NAMED]]
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    one = len(names) == 1
    return (
        f"input{'' if one else 's'} {', '.join(named)}{more} {'has' if one else 'have'} no data "
        f"and {'keeps its start value' if one else 'keep their start values'}; "
        f"{driven_or_constant(names[0])}",
    )
