"""The search space: what a method moves, and what that means for each experiment.

A parameter with one value for each experiment is as many unknowns as there are experiments, but
each moves only its own experiment's residuals. So the unknowns are coloured: those of one colour
touch no experiment in common and can be perturbed in one point (A. R. Curtis, M. J. D. Powell,
J. K. Reid, IMA J. Appl. Math. 13 (1974) 117-119, doi:10.1093/imamat/13.1.117).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from cluster_est.errors import ProblemError
from cluster_est.formulas import ParameterConstraint, parse_constraint
from cluster_est.problem import Parameter, Problem
from workers.description import nearest
from workers.messages import Experiment, FloatArray, IntArray


@dataclass(frozen=True)
class Unknown:
    """One number that a method moves.

    Attributes
    ----------
    label
        "k", or "x0[exp5]" where the parameter has a value of its own there.
    parameter
        Whose value it is.
    column
        Its place in `Model.parameters`.
    experiments
        Positions, in the space, of the experiments that it acts on.
    start
        Physical value that the search starts from.
    """

    label: str
    parameter: Parameter
    column: int
    experiments: tuple[int, ...]
    start: float

    @property
    def log(self) -> bool:
        return self.parameter.scale == "log"

    def to_search(self, physical: float) -> float:
        if not self.log:
            return physical
        return math.log(physical) if physical > 0.0 else -math.inf

    def to_physical(self, searched: float) -> float:
        if not self.log:
            return searched
        # the exponential of a bound's logarithm may lie just outside the bound
        return min(max(math.exp(min(searched, 709.0)), self.parameter.lower), self.parameter.upper)


@dataclass(frozen=True)
class Space:
    """Some experiments of a problem, and the unknowns that act on them.

    Methods see points x of `size` numbers: physical values, or their logarithms where the
    parameter's scale is "log".

    Attributes
    ----------
    problem
        Whose space it is.
    experiments
        Indices into the problem's experiments.
    unknowns
        What a method moves.
    base : (experiments, parameters)
        Physical values where nothing is moved.
    """

    problem: Problem
    experiments: tuple[int, ...]
    unknowns: tuple[Unknown, ...]
    base: FloatArray = field(repr=False)

    @property
    def size(self) -> int:
        return len(self.unknowns)

    @cached_property
    def start(self) -> FloatArray:
        return np.array([u.to_search(u.start) for u in self.unknowns], np.float64)

    @cached_property
    def lower(self) -> FloatArray:
        return np.array([u.to_search(u.parameter.lower) for u in self.unknowns], np.float64)

    @cached_property
    def upper(self) -> FloatArray:
        return np.array([u.to_search(u.parameter.upper) for u in self.unknowns], np.float64)

    @cached_property
    def typical(self) -> FloatArray:
        """The size of a noticeable change of each unknown, where nothing better is known."""
        return np.array([_typical(u) for u in self.unknowns], np.float64)

    @cached_property
    def rows(self) -> tuple[slice, ...]:
        """Where each experiment's residuals stand in the residuals of a point.

        Not those of cost functions, which are known only from an evaluation.
        """
        sizes = [self.problem.experiments[e].size for e in self.experiments]
        return _slices(sizes)

    @cached_property
    def outputs(self) -> IntArray:
        """(residuals,): which output each residual is of, counted over all experiments.

        A curve counts as one output. Empty where there are cost functions.
        """
        known: dict[object, int] = {}
        parts = [np.zeros(0, np.int64)]
        for e in self.experiments:
            experiment = self.problem.experiments[e]
            if experiment.cost_function is not None:
                return np.zeros(0, np.int64)
            for output in experiment.outputs:
                number = known.setdefault(output.variable, len(known))
                parts.append(np.full(len(output.times), number))
            if experiment.curve is not None:
                number = known.setdefault(experiment.curve.variables, len(known))
                parts.append(np.full(len(experiment.curve.points) - 1, number))
        return np.concatenate(parts)

    @cached_property
    def constraint_names(self) -> tuple[str, ...]:
        """Of all constraints: those on parameters, then each experiment's."""
        names = [name for name, _, _ in self._parameter_constraints]
        for e in self.experiments:
            experiment = self.problem.experiments[e]
            names += [f"{name} [{experiment.id}]" for name in experiment.constraint_names]
        return tuple(names)

    @cached_property
    def equality(self) -> npt.NDArray[np.bool_]:
        """(constraints,): whether each must be 0, else at most 0."""
        kinds = [constraint.equality for _, constraint, _ in self._parameter_constraints]
        for e in self.experiments:
            kinds += self.problem.experiments[e].equality
        return np.array(kinds, dtype=bool)

    @cached_property
    def constraint_rows(self) -> tuple[slice, ...]:
        """Where each experiment's constraints stand among all."""
        first = len(self._parameter_constraints)
        sizes = [len(self.problem.experiments[e].constraint_names) for e in self.experiments]
        return tuple(slice(s.start + first, s.stop + first) for s in _slices(sizes))

    @cached_property
    def _parameter_constraints(self) -> tuple[tuple[str, ParameterConstraint, int], ...]:
        """(name, constraint, experiment) once for each combination of values it can meet."""
        parameters = self.problem.parameters
        found = []
        for constraint in (*self.problem.constraints, *_bounds_of_derived(self.problem)):
            needed = _sources(self.problem, constraint.formula.names)
            local = [p for p in parameters if p.name in needed and p.per is not None]
            seen: dict[tuple[object, ...], int] = {}
            for position, e in enumerate(self.experiments):
                experiment = self.problem.experiments[e]
                values = tuple(self.base[position].tolist()) if self._given_differs(needed) else ()
                labels = (*(_label(p, experiment) for p in local), *values)
                seen.setdefault(labels, position)
            for position in seen.values():
                where = f" [{self.problem.experiments[self.experiments[position]].id}]"
                name = constraint.name + (where if len(seen) > 1 else "")
                found.append((name, constraint, position))
        return tuple(found)

    def _given_differs(self, names: set[str]) -> bool:
        """Whether experiments bring known values of their own for one of these parameters."""
        targets = {p.target for p in self.problem.parameters if p.name in names}
        chosen = [self.problem.experiments[e] for e in self.experiments]
        return any(name in targets for experiment in chosen for name, _ in experiment.values)

    def parameter_constraints(self, x: FloatArray) -> FloatArray:
        """The constraints on parameters at x: the first of `constraint_names`."""
        if not self._parameter_constraints:
            return np.zeros(0)
        table = self._table(x)
        columns = {p.name: table[:, i] for i, p in enumerate(self.problem.parameters)}
        found = [
            constraint.formula.values(columns, len(table))[position] / constraint.scale
            for _, constraint, position in self._parameter_constraints
        ]
        return np.array(found, np.float64)

    def parameter_constraint_slopes(self, x: FloatArray) -> FloatArray:
        """(constraints on parameters, unknowns): their derivatives, by central differences.

        They cost no simulation.
        """
        slopes = np.zeros((len(self._parameter_constraints), self.size))
        if not len(slopes):
            return slopes
        for i in range(self.size):
            step = np.cbrt(np.finfo(float).eps) * max(abs(float(x[i])), float(self.typical[i]))
            high, low = x.copy(), x.copy()
            high[i], low[i] = x[i] + step, x[i] - step
            ahead, behind = self.parameter_constraints(high), self.parameter_constraints(low)
            slopes[:, i] = (ahead - behind) / (high[i] - low[i])
        return np.where(np.isfinite(slopes), slopes, 0.0)

    @cached_property
    def acts_on(self) -> npt.NDArray[np.bool_]:
        """(unknowns, experiments): whether an unknown can move an experiment's residuals."""
        result = np.zeros((self.size, len(self.experiments)), dtype=bool)
        for i, unknown in enumerate(self.unknowns):
            result[i, list(unknown.experiments)] = True
        return result

    @cached_property
    def colours(self) -> tuple[IntArray, ...]:
        """Unknowns that share no experiment, colour after colour; each unknown has one colour."""
        taken: list[npt.NDArray[np.bool_]] = []
        members: list[list[int]] = []
        for i, touched in enumerate(self.acts_on):
            for colour, used in enumerate(taken):
                if not (used & touched).any():
                    used |= touched
                    members[colour].append(i)
                    break
            else:
                taken.append(touched.copy())
                members.append([i])
        return tuple(np.array(group, dtype=np.intp) for group in members)

    def physical(self, x: FloatArray) -> FloatArray:
        """(experiments, parameters): the values that each experiment is simulated with at x."""
        table = self._table(x)
        parameters = self.problem.parameters
        inside = [i for i, p in enumerate(parameters) if not p.auxiliary]
        return table if len(inside) == len(parameters) else np.ascontiguousarray(table[:, inside])

    def _table(self, x: FloatArray) -> FloatArray:
        """(experiments, all parameters): with what follows from others, and auxiliary ones."""
        values = self.base.copy()
        for unknown, searched in zip(self.unknowns, x.tolist(), strict=True):
            values[list(unknown.experiments), unknown.column] = unknown.to_physical(searched)
        if self.problem.derived:
            columns = {p.name: values[:, i] for i, p in enumerate(self.problem.parameters)}
            for i, formula in self.problem.derived:
                free = self._free[:, i]
                values[free, i] = formula.values(columns, len(values))[free]
        return values

    @cached_property
    def _free(self) -> npt.NDArray[np.bool_]:
        """(experiments, all parameters): whether the experiment brings no value of its own."""
        given = [dict(self.problem.experiments[e].values) for e in self.experiments]
        return np.array([[p.target not in g for p in self.problem.parameters] for g in given])

    def derived(self, x: FloatArray) -> dict[str, float]:
        """Physical values, by label, of what follows from others at x."""
        table = self._table(x)
        found: dict[str, float] = {}
        for i, _ in self.problem.derived:
            name = self.problem.parameters[i].name
            shared = bool(np.all(table[:, i] == table[0, i]))
            for position, e in enumerate(self.experiments):
                label = name if shared else f"{name}[{self.problem.experiments[e].id}]"
                found[label] = float(table[position, i])
        return found

    def estimates(self, x: FloatArray) -> dict[str, float]:
        """Physical values by label."""
        pairs = zip(self.unknowns, x.tolist(), strict=True)
        return {unknown.label: unknown.to_physical(searched) for unknown, searched in pairs}


def make_space(
    problem: Problem,
    experiments: tuple[int, ...],
    known: Mapping[str, float] | None = None,
    starts: Mapping[str, float] | None = None,
) -> Space:
    """Expand parameters into unknowns, over some of the experiments.

    Parameters
    ----------
    problem
        What is estimated.
    experiments
        Indices of the experiments that the search may see.
    known
        Physical values by label: those are kept, not searched. This is how test experiments get
        the shared values that the training experiments gave.
    starts
        Physical values by label that the search starts from, instead of the parameters' own.
    """
    known, starts = known or {}, starts or {}
    chosen = [problem.experiments[e] for e in experiments]
    base = np.empty((len(chosen), len(problem.parameters)))
    unknowns: list[Unknown] = []
    for column, parameter in enumerate(problem.parameters):
        given = [dict(e.values).get(parameter.target) for e in chosen]
        base[:, column] = [parameter.start if v is None else float(v) for v in given]
        members: dict[str, list[int]] = {}
        for position, experiment in enumerate(chosen):
            if given[position] is None and not parameter.fixed:
                members.setdefault(_label(parameter, experiment), []).append(position)
        for label, positions in members.items():
            if label in known:
                base[positions, column] = known[label]
            else:
                start = starts.get(label, parameter.start)
                unknowns.append(Unknown(label, parameter, column, tuple(positions), start))
    return Space(problem, experiments, tuple(unknowns), base)


def _slices(sizes: list[int]) -> tuple[slice, ...]:
    ends = np.cumsum([0, *sizes]).tolist()
    return tuple(slice(a, b) for a, b in pairwise(ends))


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
        scale = max(abs(b) for b in (p.lower, p.upper, 0.0) if math.isfinite(b)) or 1.0
        if math.isfinite(p.lower):
            text = f"{p.lower!r} <= {p.name}"
            found += parse_constraint(text, names, f"parameters.{p.name}.bounds", "", scale)
        if math.isfinite(p.upper):
            text = f"{p.name} <= {p.upper!r}"
            found += parse_constraint(text, names, f"parameters.{p.name}.bounds", "", scale)
    return found


def _label(parameter: Parameter, experiment: Experiment) -> str:
    if parameter.per is None:
        return parameter.name
    if parameter.per == "experiment":
        return f"{parameter.name}[{experiment.id}]"
    key = parameter.per.partition(":")[2] or "group"
    groups = dict(experiment.groups)
    label = groups.get(key, groups.get(""))
    if label is None:
        raise ProblemError(
            f"experiment {experiment.id!r}: must belong to a group, because "
            f"parameters.{parameter.name} is per {parameter.per!r}, but does not; add "
            f'group = {{ {key} = "..." }}' + (nearest(key, groups) if groups else "")
        )
    return f"{parameter.name}[{label}]"


def _typical(unknown: Unknown) -> float:
    """A logarithm changes noticeably by 1; a value by itself, else by a tenth of its range."""
    if unknown.log:
        return 1.0
    width = unknown.parameter.upper - unknown.parameter.lower
    if unknown.start != 0.0:
        return abs(unknown.start)
    return 0.1 * width if math.isfinite(width) else 1.0
