"""Unknowns of a search, and the residuals and constraints that depend on them directly.

These are priors, constraints on parameters, and the continuity of states. They need no simulation
in addition to that of the outputs.

A constraint on a parameter with one value per experiment must hold in each experiment. A constraint
on shared parameters only must hold once.

If a record is cut into segments that are simulated separately, the initial state s_k of a segment
is an unknown. It must equal the final state of the previous segment:

    r = w (s_k - x_end) / scale.

A worker sends x_end as the residual of an output that is compared with an arbitrary value.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.problem.formulas import ParameterConstraint, parse_constraint
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.priors import Prior
from cluster_est.problem.problem import Problem
from cluster_est.toml import dotted
from workers.fmu.description import nearest
from workers.messages import Experiment, FloatArray, IntArray


def scope_of(label: str, name: str) -> str:
    """Return the experiment or group in a parameter's label: "exp5" of "x0[exp5]"; "" if shared.

    The name may contain brackets, such as the name of an array's element.
    """
    return label.removeprefix(name)[1:-1]


@dataclass(frozen=True)
class Unknown:
    """One number that a method changes.

    Attributes
    ----------
    label
        "k", or "x0[exp5]" for a parameter with its own value in that experiment.
    parameter
        The parameter to which the value belongs.
    column
        Index of the parameter in `Problem.parameters`.
    experiments
        Positions in the space of the experiments with this value.
    start
        Physical start value.
    size
        Size of a noticeable change, if it is known better than from the start value; 0 otherwise.
    """

    label: str
    parameter: Parameter
    column: int
    experiments: tuple[int, ...]
    start: float
    size: float = 0.0

    @property
    def scope(self) -> str:
        """The experiment or group with this value; "" if all share it."""
        return scope_of(self.label, self.parameter.name)

    @property
    def log(self) -> bool:
        return self.parameter.scale == "log"

    @property
    def prior(self) -> Prior | None:
        return self.parameter.prior

    def prior_residual(self, searched: float) -> float:
        """Return the residual of the prior at a value in search coordinates; 0 without a prior."""
        return 0.0 if self.prior is None else self.prior.residual(self.to_physical(searched))

    def prior_slope(self, searched: float) -> float:
        """Return the derivative of `prior_residual`."""
        if self.prior is None:
            return 0.0
        value = self.to_physical(searched)
        return self.prior.slope(value) * (value if self.log else 1.0)

    def to_search(self, physical: float) -> float:
        if not self.log:
            return physical
        return math.log(physical) if physical > 0.0 else -math.inf

    def to_physical(self, searched: float) -> float:
        if not self.log:
            return searched
        # the exponential of a bound's logarithm may lie just outside the bound
        return min(max(math.exp(min(searched, 709.0)), self.parameter.lower), self.parameter.upper)

    @property
    def typical(self) -> float:
        """The size of a noticeable change.

        It is 1 for a logarithm. Otherwise, it is `size`, the absolute value of the start, or for a
        start of 0 a tenth of the range. A fit measures it for a start of 0 and stores it in `size`.
        """
        if self.log:
            return 1.0
        if self.size > 0.0:
            return self.size
        if self.start != 0.0:
            return abs(self.start)
        width = self.parameter.upper - self.parameter.lower
        return 0.1 * width if math.isfinite(width) else 1.0


@dataclass(frozen=True)
class KnownPrior:
    """The prior of an unknown that is fixed, as along a profile; its residual is constant.

    Attributes
    ----------
    before
        Index of the unknown before which the fixed unknown would be.
    experiment
        Position of the experiment to whose residuals the prior belongs.
    residual
        Residual of the fixed value.
    """

    before: int
    experiment: int
    residual: float


@dataclass(frozen=True)
class PriorRows:
    """The priors of a space, each after the residuals of one experiment.

    A prior counts once, with the first experiment that depends on its unknown. So finite
    differences and colours include it without changes.

    Attributes
    ----------
    unknowns, known
        Unknowns of the space, and the priors of fixed unknowns.
    count
        Number of experiments.
    """

    unknowns: Sequence[Unknown] = field(repr=False)
    known: Sequence[KnownPrior]
    count: int

    def __bool__(self) -> bool:
        return any(len(own) for own in self.places)

    @cached_property
    def places(self) -> tuple[IntArray, ...]:
        """For each experiment, the unknowns whose priors belong to it; -1 for known priors."""
        own: list[tuple[float, int, int]] = [
            (float(i), i, unknown.experiments[0])
            for i, unknown in enumerate(self.unknowns)
            if unknown.prior is not None and unknown.experiments
        ]
        own += [(known.before - 0.5, -1, known.experiment) for known in self.known]
        found: list[list[int]] = [[] for _ in range(self.count)]
        for _, i, e in sorted(own):
            found[e].append(i)
        return tuple(np.array(each, dtype=np.intp) for each in found)

    def residuals(self, e: int, x: FloatArray) -> FloatArray:
        """Return the residuals of an experiment's priors at a point of the search: (priors,)."""
        known = (each.residual for each in self.known if each.experiment == e)
        return np.array(
            [
                self.unknowns[i].prior_residual(float(x[i])) if i >= 0 else next(known)
                for i in self.places[e].tolist()
            ],
            np.float64,
        )

    def jacobian(self, e: int, x: FloatArray, acting: IntArray) -> FloatArray:
        """Return their derivatives by the unknowns that act on the experiment: (priors, acting)."""
        own = self.places[e]
        slopes = [
            self.unknowns[i].prior_slope(float(x[i])) if i >= 0 else 0.0 for i in own.tolist()
        ]
        return np.where(own[:, None] == acting, np.array(slopes, np.float64)[:, None], 0.0)

    def among(self, rows: Sequence[slice]) -> np.ndarray:
        """Return a mask of the residuals of priors; `rows` are the rows of each experiment."""
        result = np.zeros(rows[-1].stop if rows else 0, dtype=bool)
        for row, own in zip(rows, self.places, strict=True):
            result[row.stop - len(own) : row.stop] = True
        return result


class ConstraintSpec(NamedTuple):
    """A constraint at the parameter values of the experiment at `position`."""

    name: str
    constraint: ParameterConstraint
    position: int


def expand(problem: Problem, experiments: Sequence[Experiment]) -> tuple[ConstraintSpec, ...]:
    """Return all constraints on parameters of a problem, for some of its experiments."""
    found = []
    for constraint in (*problem.constraints, *_bounds_of_derived(problem)):
        needed = _sources(problem, constraint.formula.names)
        parameters = [p for p in problem.parameters if p.name in needed]
        seen: dict[tuple[object, ...], int] = {}
        for position, experiment in enumerate(experiments):
            if any(experiment.estimates_alone(p.target) for p in parameters):
                continue  # the constraint is on the start of a record, not on parts after gaps
            given = dict(experiment.values)
            values = (given.get(p.target, label_of(p, experiment)) for p in parameters)
            seen.setdefault(tuple(values), position)
        for position in seen.values():
            where = f" [{experiments[position].id}]" if len(seen) > 1 else ""
            found.append(ConstraintSpec(constraint.name + where, constraint, position))
    return tuple(found)


def evaluate(specs: Sequence[ConstraintSpec], problem: Problem, table: FloatArray) -> FloatArray:
    """Return the constraints over their scales, for a table (experiments, parameters) of values."""
    columns = {p.name: table[:, i] for i, p in enumerate(problem.parameters)}
    with np.errstate(over="ignore"):  # a scale may be tiny
        found = [
            spec.constraint.formula.values(columns, len(table))[spec.position]
            / spec.constraint.scale
            for spec in specs
        ]
    return np.array(found, np.float64)


def _sources(problem: Problem, names: tuple[str, ...]) -> set[str]:
    """Return these parameters, and all parameters that their expressions depend on."""
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
    """Return the bounds of the derived parameters as constraints."""
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


def part_name(record: str, start: float) -> str:
    """Return the name of the part of a record that starts after a gap."""
    return f"{record} from {start:.10g} s"


def label_of(parameter: Parameter, experiment: Experiment) -> str:
    """Return the label of a parameter's unknown in an experiment.

    Training and held-out parts of a record share the initial states after a gap.
    """
    if experiment.estimates_alone(parameter.target):
        return f"{parameter.name}[{part_name(experiment.record_id, experiment.start)}]"
    if parameter.per is None:
        return parameter.name
    if parameter.per == "experiment":
        return f"{parameter.name}[{experiment.record_id}]"
    key = parameter.per.partition(":")[2] or "group"
    groups = dict(experiment.groups)
    label = groups.get(key, groups.get(""))
    if label is None:
        raise ProblemError(
            f"experiment {experiment.id!r}: must belong to a group "
            f"({dotted('parameters', parameter.name)} has per = {parameter.per!r}), but does not; "
            f'add group = {{ {key} = "..." }}' + (nearest(key, groups) if groups else "")
        )
    return f"{parameter.name}[{label}]"


@dataclass(frozen=True)
class StateEnd:
    """One state at the end of a segment, and the unknown that it must be equal to.

    Attributes
    ----------
    experiment
        Position of the segment in the space.
    row
        Index of the residual (compared - x_end) / sigma in the residuals of the segment.
    compared, sigma
        The constants of this residual.
    unknown
        Index of the initial state of the next segment.
    scale
        Scale of the difference, in the state's unit.
    """

    experiment: int
    row: int
    compared: float
    sigma: float
    unknown: int
    scale: float


@dataclass(frozen=True)
class StateContinuity:
    """The continuity conditions of all segments of a space.

    Attributes
    ----------
    ends
        Final states, in the order of the space's experiments.
    weight
        Weight w of the differences.
    """

    ends: tuple[StateEnd, ...] = field(repr=False)
    weight: float = 1.0

    @cached_property
    def of_experiment(self) -> dict[int, _EndRows]:
        """The final states of each segment, by its position."""
        found: dict[int, list[StateEnd]] = {}
        for end in self.ends:
            found.setdefault(end.experiment, []).append(end)
        return {e: _EndRows.of(ends) for e, ends in found.items()}

    def acting(self, e: int) -> list[int]:
        """Return the unknowns that the final state of a segment must equal."""
        rows = self.of_experiment.get(e)
        return [] if rows is None else rows.unknowns.tolist()

    def applied(self, e: int, x: FloatArray, residuals: FloatArray) -> FloatArray:
        """Return the residuals of a segment, with the differences of states in their rows."""
        rows = self.of_experiment.get(e)
        if rows is None:
            return residuals
        result = residuals.copy()
        result[rows.rows] = self.weight * rows.differences(x, residuals) / rows.scales
        return result

    def differences(self, applied: Sequence[FloatArray]) -> FloatArray:
        """Return s_k - x_end from the results of `applied` for all segments: (ends,)."""
        parts = [applied[e][rows.rows] for e, rows in sorted(self.of_experiment.items())]
        return np.concatenate([np.zeros(0), *parts]) * self.scales / self.weight

    @cached_property
    def scales(self) -> FloatArray:
        """Scales of the differences, in the order of `differences`: (ends,)."""
        parts = [rows.scales for _, rows in sorted(self.of_experiment.items())]
        return np.concatenate([np.zeros(0), *parts])


@dataclass(frozen=True)
class _EndRows:
    """The final states of one segment, as arrays."""

    rows: IntArray
    compared: FloatArray
    sigmas: FloatArray
    unknowns: IntArray
    scales: FloatArray

    @classmethod
    def of(cls, ends: Sequence[StateEnd]) -> _EndRows:
        return cls(
            np.array([end.row for end in ends], np.intp),
            np.array([end.compared for end in ends]),
            np.array([end.sigma for end in ends]),
            np.array([end.unknown for end in ends], np.intp),
            np.array([end.scale for end in ends]),
        )

    def differences(self, x: FloatArray, residuals: FloatArray) -> FloatArray:
        reached = self.compared - self.sigmas * residuals[self.rows]
        return np.asarray(x[self.unknowns] - reached)
