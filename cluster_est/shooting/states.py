"""The states that segments begin with: by which variables of the FMU they are set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from cluster_est.errors import ProblemError
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription


@dataclass(frozen=True)
class SegmentStates:
    """The states of a model, and the parameters that hold them.

    Attributes
    ----------
    names
        In the order of the FMU.
    owner
        The state of each name that a state has.
    parameters
        For each state, the parameter whose value a segment begins with: the problem's own where it
        estimates the state, else one that is made for it.
    added
        Those that are made.
    """

    names: tuple[str, ...]
    owner: Mapping[str, str]
    parameters: tuple[Parameter, ...]
    added: tuple[Parameter, ...]


def segment_states(problem: Problem, description: ModelDescription) -> SegmentStates:
    """Return the states of a model, if segments can begin with any of them.

    Raises
    ------
    ProblemError
        If there are none, or one cannot be set.
    """
    names = description.states
    if not names:
        raise ProblemError(
            f"method.shooting: needs a model with states but {description.file} has none, so that "
            "each sample stands alone already; leave method.shooting out"
        )
    owner = {
        alias: state for state in names for alias in (state, *description.variables[state].aliases)
    }
    taken = {p.name for p in problem.parameters}
    chosen, added = [], []
    for state in names:
        known = [p for p in problem.parameters if owner.get(p.target) == state]
        if known:
            _check_plain(known[0])
        else:
            added.append(_made(state, description, taken))
        chosen.append(known[0] if known else added[-1])
    return SegmentStates(names, owner, tuple(chosen), tuple(added))


def _check_plain(parameter: Parameter) -> None:
    if parameter.expression:
        raise ProblemError(
            f"method.shooting: needs states that are set by themselves, but {parameter.target!r} "
            f"follows from the expression of {dotted('parameters', parameter.name)}; estimate it, "
            "or give "
            "its value"
        )


def _made(state: str, description: ModelDescription, taken: set[str]) -> Parameter:
    variable = description.variables[state]
    if not variable.settable or variable.start is None:
        raise ProblemError(
            f"method.shooting: needs states whose start values can be set, but {description.file} "
            f"computes that of {state!r}; export it so that it can be set (in Modelica: "
            "start = ..., fixed = true), or leave method.shooting out"
        )
    name = state
    while name in taken:
        name += "_"
    taken.add(name)
    return Parameter(name, variable.start, variable=state, unit=variable.unit)
