"""Checks of the arguments of `fit`, `simulate`, `residuals` and `close_loop`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from os import PathLike
from typing import Any, TypeVar

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.executors import EXECUTORS
from cluster_est.methods import METHOD_ALIASES, SEARCH_METHODS, Method
from cluster_est.plug_in import check_options
from cluster_est.problem.gaps import split_at_gaps
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.resources import Budget, Resources
from cluster_est.toml import dotted
from workers.fmu.description import nearest
from workers.messages import Limits
from workers.messages.checks import check_kind, check_number, shown


def check_problem(problem: object) -> None:
    """Raise an error if an argument is not a problem.

    Raises
    ------
    ProblemError
        With advice on how to create a problem.
    """
    advice = ""
    if isinstance(problem, str | PathLike):
        advice = f"; use read_problem({shown(str(problem))})"
    elif type(problem).__name__ == "Config":
        advice = "; use build_problem(config, folder)"
    check_kind(problem, Problem, "problem", ProblemError, advice)


def prepared(problem: Problem) -> Problem:
    """Check a problem and return it with its records split at their gaps.

    Raises
    ------
    ProblemError
        If the argument is not a problem.
    """
    check_problem(problem)
    return split_at_gaps(problem)


def checked_resources(given: Resources | Mapping[str, Any] | str | None) -> Resources:
    """Return checked resources from resources, an executor's name, keys, or None for the default.

    Raises
    ------
    ProblemError
        If there is no such executor, or a number is out of its range.
    """
    resources: Resources = _named_resources(given)
    advice = '; give Resources(...), or the name of an executor such as "processes"'
    check_kind(resources, Resources, "resources", ProblemError, advice)
    if resources.executor not in EXECUTORS:
        name = str(resources.executor)
        raise ProblemError(
            f"executor.name: there is no {resources.executor!r}{nearest(name, EXECUTORS)}"
        )
    for key in ("workers", "instances"):
        value = getattr(resources, key)
        if value is not None:
            check_number(value, f"executor.{key}", ProblemError, above=0, whole=True)
    if resources.address is not None:
        check_kind(resources.address, str, "executor.address", ProblemError)
    check_kind(resources.budget, Budget, "budget", ProblemError)
    check_kind(resources.limits, Limits, "executor", ProblemError)
    for key, limit in asdict(resources.limits).items():
        if not (isinstance(limit, float) and limit == math.inf):
            check_number(limit, f"executor.limits.{key}", ProblemError, above=0.0)
    return resources


def _named_resources(given: Any) -> Any:
    """Return resources from a name or from keys; return other arguments unchanged."""
    if given is None or isinstance(given, str):
        return Resources() if given is None else Resources(given)
    if not isinstance(given, Mapping):
        return given
    keys = dict(given)
    if isinstance(keys.get("budget"), Mapping):
        keys["budget"] = Budget.of(keys["budget"])
    if isinstance(keys.get("limits"), Mapping):
        keys["limits"] = _of_keys(Limits, keys["limits"], "executor.limits")
    return _of_keys(Resources, keys, "executor")


Keyed = TypeVar("Keyed", Resources, Limits)


def _of_keys(kind: type[Keyed], given: Mapping[str, Any], where: str) -> Keyed:
    """Return a dataclass from its fields by name."""
    known = [each.name for each in fields(kind)]
    for key in given:
        if key not in known:
            raise ProblemError(f"{where}: there is no key {key!r}{nearest(str(key), known)}")
    return kind(**given)


def method_of(method: Method | str) -> Method:
    """Return a checked method, or the method with a name from a config.

    Raises
    ------
    ProblemError
        If there is no method of that name.
    """
    if isinstance(method, str):
        name = METHOD_ALIASES.get(method, method)
        if name not in SEARCH_METHODS:
            raise ProblemError(
                f"method.name: there is no {method!r}{nearest(method, SEARCH_METHODS)}"
            )
        return SEARCH_METHODS[name]()
    check_kind(method, Method, "method", ProblemError, "; give a method or its name")
    check_options(method, "method.options", ProblemError)
    return method


def check_method(method: Method, space: SearchSpace) -> None:
    """Raise an error if a method cannot solve this problem.

    Raises
    ------
    ProblemError
        If there is nothing to estimate, or the method needs another cost.
    """
    if space.size == 0:
        raise ProblemError(
            "parameters: at least one must be free, so that there is something to estimate from "
            "the training experiments, but all are fixed or known; for a simulation without "
            "estimation, use: cluster-est simulate"
        )
    cost = space.problem.cost
    probe = np.ones(len(space.outputs))
    if method.needs_residuals and cost.weights(probe, space.outputs) is None:
        raise ProblemError(
            f"method.name: {method.name} needs residuals whose squares can be weighted, but "
            f"cost.name is {cost.name!r}; change one of the two, for example the method to sqp or "
            "pattern_search"
        )
    if space.constraint_names and not method.keeps_constraints:
        raise ProblemError(
            f"method.name: {method.name} does not support constraints, but the problem has some, "
            f"such as {space.constraint_names[0]!r}; choose least_squares, sqp or pattern_search, "
            "or remove the constraints"
        )
    method.check(space)


def check_values(problem: Problem, values: Mapping[str, float]) -> None:
    """Check values of unknowns by label.

    Raises
    ------
    ProblemError
        If a label is unknown, or its value is not a finite number.
    """
    check_kind(values, Mapping, "values", ProblemError, "; write {name: value}")
    labels = [u.label for u in make_space(problem, tuple(range(len(problem.experiments)))).unknowns]
    for name, value in values.items():
        if name not in labels:
            raise ProblemError(
                f"{dotted('values', name)}: must be an unknown of the problem, but is "
                f"not{nearest(str(name), labels)}"
            )
        check_number(value, dotted("values", name), ProblemError)
