"""Constraints on parameters, once for each combination of values that they can meet.

A constraint that names a parameter with a value for each experiment must hold in each of them; one
that names shared parameters alone must hold once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.problem.formulas import ParameterConstraint, parse_constraint
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.toml import dotted
from workers.fmu.description import nearest
from workers.messages import Experiment, FloatArray


class ConstraintSpec(NamedTuple):
    """A constraint at the values that one experiment, by its position, is simulated with."""

    name: str
    constraint: ParameterConstraint
    position: int


def expand(problem: Problem, experiments: Sequence[Experiment]) -> tuple[ConstraintSpec, ...]:
    """Every constraint on parameters of a problem, over some of its experiments."""
    found = []
    for constraint in (*problem.constraints, *_bounds_of_derived(problem)):
        needed = _sources(problem, constraint.formula.names)
        parameters = [p for p in problem.parameters if p.name in needed]
        seen: dict[tuple[object, ...], int] = {}
        for position, experiment in enumerate(experiments):
            given = dict(experiment.values)
            values = (given.get(p.target, label_of(p, experiment)) for p in parameters)
            seen.setdefault(tuple(values), position)
        for position in seen.values():
            where = f" [{experiments[position].id}]" if len(seen) > 1 else ""
            found.append(ConstraintSpec(constraint.name + where, constraint, position))
    return tuple(found)


def evaluate(specs: Sequence[ConstraintSpec], problem: Problem, table: FloatArray) -> FloatArray:
    """The constraints from an (experiments, parameters) table of values, over their scales."""
    columns = {p.name: table[:, i] for i, p in enumerate(problem.parameters)}
    with np.errstate(over="ignore"):  # a scale may be tiny
        found = [
            spec.constraint.formula.values(columns, len(table))[spec.position]
            / spec.constraint.scale
            for spec in specs
        ]
    return np.array(found, np.float64)


def _sources(problem: Problem, names: tuple[str, ...]) -> set[str]:
    """These parameters, and all that their expressions lead to."""
    formulas = {problem.parameters[i].name: formula for i, formula in problem.derived}
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += formulas[name].names if name in formulas else ()
    return found


def _bounds_of_derived(problem: Problem) -> list[ParameterConstraint]:
    """A parameter that follows from others keeps its bounds by constraints."""
    names = tuple(p.name for p in problem.parameters)
    found: list[ParameterConstraint] = []
    for i, _ in problem.derived:
        p = problem.parameters[i]
        finite = [abs(bound) for bound in (p.lower, p.upper) if math.isfinite(bound)]
        scale = max(finite, default=0.0) or 1.0
        where = f"{dotted('parameters', p.name)}.bounds"
        texts = {p.lower: f"{p.lower!r} <= {p.name}", p.upper: f"{p.name} <= {p.upper!r}"}
        for bound, text in texts.items():
            if math.isfinite(bound):
                found += parse_constraint(text, names, where, "", scale)
    return found


def label_of(parameter: Parameter, experiment: Experiment) -> str:
    """Return the label of a parameter's unknown in an experiment."""
    if parameter.per is None:
        return parameter.name
    if parameter.per == "experiment":
        return f"{parameter.name}[{experiment.record_id}]"
    key = parameter.per.partition(":")[2] or "group"
    groups = dict(experiment.groups)
    label = groups.get(key, groups.get(""))
    if label is None:
        raise ProblemError(
            f"experiment {experiment.id!r}: must belong to a group, because "
            f"{dotted('parameters', parameter.name)} is per {parameter.per!r}, but does not; add "
            f'group = {{ {key} = "..." }}' + (nearest(key, groups) if groups else "")
        )
    return f"{parameter.name}[{label}]"
