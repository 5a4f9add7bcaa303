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
        """Where each experiment's residuals stand in the residuals of a point."""
        sizes = [self.problem.experiments[e].size for e in self.experiments]
        ends = np.cumsum([0, *sizes]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

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
        values = self.base.copy()
        for unknown, searched in zip(self.unknowns, x.tolist(), strict=True):
            values[list(unknown.experiments), unknown.column] = unknown.to_physical(searched)
        return values

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
