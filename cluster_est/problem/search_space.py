"""The search space: the unknowns of a method, and the parameter values of each experiment.

A parameter with one value per experiment gives as many unknowns as there are experiments, but each
of them changes only the residuals of its own experiment. So the unknowns are coloured: unknowns of
one colour have no experiment in common, and one point can perturb all of them (A. R. Curtis, M. J.
D. Powell, J. K. Reid, IMA J. Appl. Math. 13 (1974) 117-119, doi:10.1093/imamat/13.1.117).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from cluster_est.problem.costs import Cost
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.unknowns import (
    ConstraintSpec,
    KnownPrior,
    PriorRows,
    StateContinuity,
    Unknown,
    evaluate,
    expand,
    label_of,
)
from workers.messages import Experiment, FloatArray, IntArray, Want

LEAST_RESIDUALS = 10
"""Mean number of residuals per output up to which a reduced answer saves nothing: an answer has
about as many other bytes, and all residuals may save a simulation in another search."""


def want_of(experiment: Experiment, cost: Cost | None) -> Want:
    """Return the kind of answer that an experiment must give if only this cost is needed.

    A cost of None means that single residuals are also needed. The answer depends only on the
    problem and never on the workers, so that results cannot depend on the workers. Values of a
    user's cost function are never reduced, because they do not belong to outputs.
    """
    if cost is None or cost.reduction is None or experiment.cost_function is not None:
        return "residuals"
    filled = sum(count > 0 for count in experiment.counts)
    return cost.reduction if experiment.size > LEAST_RESIDUALS * filled else "residuals"


_NONE = np.zeros(0)
_PRIOR = object()
"""Marks the priors in a list of outputs."""


@dataclass(frozen=True)
class SearchSpace:
    """Some experiments of a problem, and the unknowns that act on them.

    Methods use points x with `size` numbers: physical values, or their logarithms if the
    parameter's scale is "log".

    Attributes
    ----------
    experiments
        Indices of the experiments in the problem.
    unknowns
        The values that a method changes.
    base : (experiments, parameters)
        Physical values of parameters that are not unknowns.
    reduced
        Whether single residuals are not needed. Long experiments then return one number for each
        output instead of its residuals.
    known_priors
        Priors of unknowns that are fixed in this space, as along a profile; they still add to the
        cost.
    continuity
        If experiments are segments of records: the conditions that each segment starts where the
        previous one ended.
    """

    problem: Problem
    experiments: tuple[int, ...]
    unknowns: tuple[Unknown, ...]
    base: FloatArray = field(repr=False)
    reduced: bool = False
    known_priors: tuple[KnownPrior, ...] = ()
    continuity: StateContinuity | None = None

    @property
    def size(self) -> int:
        return len(self.unknowns)

    @cached_property
    def start(self) -> FloatArray:
        start = np.array([u.to_search(u.start) for u in self.unknowns], np.float64)
        return np.clip(start, self.lower, self.upper)  # by rounding, a logarithm may be outside

    def starting_at(self, x: FloatArray) -> SearchSpace:
        """Return a space with another start, in search coordinates."""
        if np.array_equal(x, self.start):
            return self
        pairs = zip(self.unknowns, x.tolist(), strict=True)
        moved = tuple(replace(u, start=u.to_physical(searched)) for u, searched in pairs)
        return replace(self, unknowns=moved)

    @cached_property
    def lower(self) -> FloatArray:
        return np.array([u.to_search(u.parameter.lower) for u in self.unknowns], np.float64)

    @cached_property
    def upper(self) -> FloatArray:
        return np.array([u.to_search(u.parameter.upper) for u in self.unknowns], np.float64)

    @cached_property
    def typical(self) -> FloatArray:
        """The size of a noticeable change of each unknown, if nothing better is known."""
        return np.array([u.typical for u in self.unknowns], np.float64)

    @cached_property
    def wants(self) -> tuple[Want, ...]:
        """The requested kind of answer of each experiment: all residuals, or less."""
        cost = self.problem.cost if self.reduced else None
        return tuple(want_of(self.problem.experiments[e], cost) for e in self.experiments)

    @cached_property
    def _counts(self) -> list[tuple[int, ...]]:
        """For each experiment, the number of residuals (or replacements) of each output.

        The number for the priors that belong to the experiment comes last.
        """
        pairs = zip(self.experiments, self.wants, self.priors.places, strict=True)
        return [
            (*self.problem.experiments[e].counts_in(want), *([len(own)] if len(own) else []))
            for e, want, own in pairs
        ]

    @cached_property
    def priors(self) -> PriorRows:
        """The residuals of priors, which follow those of the experiments' outputs."""
        return PriorRows(self.unknowns, self.known_priors, len(self.experiments))

    @cached_property
    def rows(self) -> tuple[slice, ...]:
        """The slice of each experiment in the residuals of a point.

        Residuals of cost functions are not included, because their number is known only from an
        evaluation.
        """
        return _slices([sum(counts) for counts in self._counts])

    @property
    def free_observations(self) -> int:
        """The number of scales and offsets of outputs that are also estimated, in closed form."""
        found = [o for e in self.experiments for o in self.problem.experiments[e].outputs]
        return sum(o.free_scale + o.free_offset for o in found if len(o.times))

    @property
    def hidden_values(self) -> int:
        """The number of measured values below a detection limit."""
        found = [o for e in self.experiments for o in self.problem.experiments[e].outputs]
        return sum(int(o.is_hidden.sum()) for o in found)

    @property
    def has_ordinal_values(self) -> bool:
        """Whether some measured values are ordinal, so that their noise is not known."""
        found = [o for e in self.experiments for o in self.problem.experiments[e].outputs]
        return any(output.ordinal and len(output.times) for output in found)

    @cached_property
    def outputs(self) -> IntArray:
        """Index of each residual's output, counted over all experiments: (residuals,).

        A curve counts as one output. Empty if there are cost functions.
        """
        known: dict[object, int] = {}
        parts = [np.zeros(0, np.int64)]
        for e, counts in zip(self.experiments, self._counts, strict=True):
            experiment = self.problem.experiments[e]
            if experiment.cost_function is not None:
                return np.zeros(0, np.int64)
            names: list[object] = [output.variable for output in experiment.outputs]
            names += [experiment.curve.variables] if experiment.curve is not None else []
            names += [_PRIOR] if len(counts) > len(names) else []
            for name, count in zip(names, counts, strict=True):
                parts.append(np.full(count, known.setdefault(name, len(known))))
        return np.concatenate(parts)

    @cached_property
    def constraint_names(self) -> tuple[str, ...]:
        """Names of all constraints: those on parameters, then those of each experiment."""
        names = [spec.name for spec in self._specs]
        for e in self.experiments:
            experiment = self.problem.experiments[e]
            names += [f"{name} [{experiment.id}]" for name in experiment.constraint_names]
        return tuple(names)

    @cached_property
    def equality(self) -> npt.NDArray[np.bool_]:
        """Whether each constraint must be 0, and not only at most 0: (constraints,)."""
        kinds = [spec.constraint.equality for spec in self._specs]
        for e in self.experiments:
            kinds += self.problem.experiments[e].equality
        return np.array(kinds, dtype=bool)

    @cached_property
    def constraint_rows(self) -> tuple[slice, ...]:
        """The slice of each experiment in all constraints."""
        first = len(self._specs)
        sizes = [len(self.problem.experiments[e].constraint_names) for e in self.experiments]
        return tuple(slice(s.start + first, s.stop + first) for s in _slices(sizes))

    @cached_property
    def _specs(self) -> tuple[ConstraintSpec, ...]:
        chosen = [self.problem.experiments[e] for e in self.experiments]
        return expand(self.problem, chosen)

    def parameter_constraints(self, x: FloatArray) -> FloatArray:
        """Return the constraints on parameters at x; they come first in `constraint_names`."""
        return evaluate(self._specs, self.problem, self._table(x)) if self._specs else _NONE

    def parameter_constraint_jacobian(self, x: FloatArray) -> FloatArray:
        """Return the derivatives of parameter constraints: (constraints on parameters, unknowns).

        They are central differences, or one-sided differences at a bound, or if a constraint has no
        value on one side. They need no simulation.
        """
        derivatives = np.zeros((len(self._specs), self.size))
        if not len(derivatives):
            return derivatives
        for i in range(self.size):
            step = np.cbrt(np.finfo(float).eps) * max(abs(float(x[i])), float(self.typical[i]))
            high, low = x.copy(), x.copy()
            high[i] = min(x[i] + step, self.upper[i])
            low[i] = max(x[i] - step, self.lower[i])
            ahead, behind = self.parameter_constraints(high), self.parameter_constraints(low)
            central = (ahead - behind) / (high[i] - low[i])
            if not np.isfinite(central).all():  # such as near the limit of a root's domain
                here = self.parameter_constraints(x)
                with np.errstate(divide="ignore", invalid="ignore"):
                    sides = (ahead - here) / (high[i] - x[i]), (here - behind) / (x[i] - low[i])
                for side in sides:
                    central = np.where(np.isfinite(central), central, side)
            derivatives[:, i] = central
        return np.where(np.isfinite(derivatives), derivatives, 0.0)

    @cached_property
    def acting(self) -> tuple[IntArray, ...]:
        """For each experiment, the sorted indices of the unknowns that can change its residuals."""
        found: list[list[int]] = [[] for _ in self.experiments]
        for i, touched in enumerate(self._touched):
            for e in touched:
                found[e].append(i)
        return tuple(np.array(each, dtype=np.intp) for each in found)

    @cached_property
    def _touched(self) -> list[tuple[int, ...]]:
        """For each unknown, the experiments whose residuals it can change."""
        touched = [set(unknown.experiments) for unknown in self.unknowns]
        if self.continuity is not None:
            for e in self.continuity.of_experiment:
                for i in self.continuity.acting(e):
                    touched[i].add(e)
        return [tuple(sorted(each)) for each in touched]

    @property
    def acts_on(self) -> npt.NDArray[np.bool_]:
        """Whether an unknown can change an experiment's residuals: (unknowns, experiments)."""
        result = np.zeros((self.size, len(self.experiments)), dtype=bool)
        for e, unknowns in enumerate(self.acting):
            result[unknowns, e] = True
        return result

    @cached_property
    def colours(self) -> tuple[IntArray, ...]:
        """The unknowns of each colour, which have no experiment in common; see the module."""
        taken: list[set[int]] = []
        members: list[list[int]] = []
        for i, touched in enumerate(self._touched):
            for colour, used in enumerate(taken):
                if used.isdisjoint(touched):
                    used.update(touched)
                    members[colour].append(i)
                    break
            else:
                taken.append(set(touched))
                members.append([i])
        return tuple(np.array(group, dtype=np.intp) for group in members)

    def physical(self, x: FloatArray) -> FloatArray:
        """Return the parameter values of each experiment at x: (experiments, parameters)."""
        table = self._table(x)
        parameters = self.problem.parameters
        inside = [i for i, p in enumerate(parameters) if not p.auxiliary]
        return table if len(inside) == len(parameters) else np.ascontiguousarray(table[:, inside])

    def _table(self, x: FloatArray) -> FloatArray:
        """Return all values, with derived and auxiliary parameters: (experiments, parameters)."""
        values = self.base.copy()
        rows, places, counts = self._places
        moved = x.astype(np.float64)
        for i in np.flatnonzero(self.logarithmic).tolist():
            moved[i] = self.unknowns[i].to_physical(float(x[i]))
        values[rows, places] = np.repeat(moved, counts)
        if self.problem.derived:
            columns = {p.name: values[:, i] for i, p in enumerate(self.problem.parameters)}
            for i, formula in self.problem.derived:
                free = self._free[:, i]
                values[free, i] = formula.values(columns, len(values))[free]
        return values

    @cached_property
    def _places(self) -> tuple[IntArray, IntArray, IntArray]:
        """Rows and columns of the unknowns in the table, and the number of places of each one."""
        counts = np.array([len(u.experiments) for u in self.unknowns], np.intp)
        rows = np.fromiter((e for u in self.unknowns for e in u.experiments), np.intp)
        columns = np.array([u.column for u in self.unknowns], np.intp)
        return rows, np.repeat(columns, counts), counts

    @cached_property
    def logarithmic(self) -> npt.NDArray[np.bool_]:
        """Whether the logarithm of each unknown is searched: (unknowns,)."""
        return np.array([unknown.log for unknown in self.unknowns], dtype=bool)

    @cached_property
    def _free(self) -> npt.NDArray[np.bool_]:
        """Whether an experiment does not set a parameter itself: (experiments, all parameters)."""
        chosen = [self.problem.experiments[e] for e in self.experiments]
        given = [{*dict(e.values), *(own.variable for own in e.own_starts)} for e in chosen]
        return np.array([[p.target not in g for p in self.problem.parameters] for g in given])

    def derived(self, x: FloatArray) -> dict[str, float]:
        """Return the physical values at x of parameters computed from others, by label."""
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
        """Return the physical values of the unknowns at x, by label."""
        pairs = zip(self.unknowns, x.tolist(), strict=True)
        return {unknown.label: unknown.to_physical(searched) for unknown, searched in pairs}


def make_space(
    problem: Problem,
    experiments: tuple[int, ...],
    known: Mapping[str, float] | None = None,
    starts: Mapping[str, float] | None = None,
) -> SearchSpace:
    """Expand parameters into unknowns for some of the experiments.

    Parameters
    ----------
    problem
        The problem.
    experiments
        Indices of the experiments that the search may use.
    known
        Physical values by label that are fixed. So test experiments get the shared values that were
        estimated on the training experiments.
    starts
        Physical start values by label, instead of the parameters' own.
    """
    known, starts = known or {}, starts or {}
    chosen = [problem.experiments[e] for e in experiments]
    base = np.empty((len(chosen), len(problem.parameters)))
    unknowns: list[Unknown] = []
    for column, parameter in enumerate(problem.parameters):
        given = [dict(e.values).get(parameter.target) for e in chosen]
        base[:, column] = [parameter.start if v is None else float(v) for v in given]
        members: dict[str, list[int]] = {}
        kept = parameter.fixed or bool(parameter.expression) or parameter.per == "gap"
        for position, experiment in enumerate(chosen):
            alone = experiment.estimates_alone(parameter.target)
            if given[position] is None and (alone or not kept):
                members.setdefault(label_of(parameter, experiment), []).append(position)
        for label, positions in members.items():
            if label in known:
                base[positions, column] = known[label]
            else:
                own = _of_part(parameter, chosen[positions[0]])
                start = starts.get(label, own.start)
                unknowns.append(Unknown(label, own, column, tuple(positions), start))
    return SearchSpace(problem, experiments, tuple(unknowns), base)


def _of_part(parameter: Parameter, experiment: Experiment) -> Parameter:
    """Return a parameter for an experiment; an initial state after a gap has no prior and scale."""
    for own in experiment.own_starts:
        if own.variable == parameter.target:
            return Parameter(
                parameter.name,
                own.start,
                (own.lower, own.upper),
                variable=parameter.variable,
                per="gap",
                unit=parameter.unit,
            )
    return parameter


def _slices(sizes: list[int]) -> tuple[slice, ...]:
    ends = np.cumsum([0, *sizes]).tolist()
    return tuple(slice(a, b) for a, b in pairwise(ends))
