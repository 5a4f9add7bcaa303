"""Sensitivity analysis: sample between the bounds, simulate, compute indices, order the unknowns.

Indices measure how much an unknown changes the cost and the outputs between its bounds (A. Saltelli
et al., Global Sensitivity Analysis: The Primer (2008), doi:10.1002/9780470725184).

The order shows which unknowns can be estimated together. It uses the local sensitivities S = J D,
which are derivatives of the residuals times a noticeable change of each unknown. The size of a
column measures the influence of an unknown on the data. Nearly dependent columns belong to unknowns
that can compensate each other. The collinearity index is 1 / sqrt(smallest eigenvalue of N'N),
where N contains the columns scaled to length 1. The other unknowns can compensate a change of one
unknown up to a fraction of 1 / index (R. Brun, P. Reichert, H. R. Kuensch, Water Resour. Res. 37
(2001) 1015-1030, doi:10.1029/2000WR900350). The order is that of a QR decomposition with column
pivoting (M. Burth, G. C. Verghese, M. Velez-Reyes, IEEE Trans. Power Syst. 14 (1999) 218-225,
doi:10.1109/59.744536).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import qr
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.methods.method import GivenPoints
from cluster_est.problem.compatibility import without_priors
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.arguments import check_problem, prepared
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.progress_line import Callback
from cluster_est.running.resources import Record, Resources, Show, one_blas_thread
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.running.study import Study, run_study
from cluster_est.sensitivity.designs import DESIGNS, SensitivityDesign, SensitivityIndex
from cluster_est.sensitivity.result import (
    AnalysedQuantity,
    IndexRow,
    PointReader,
    RankedUnknown,
    SensitivityResult,
    reader_of,
    with_log_cost,
)
from cluster_est.sensitivity.settings import SensitivitySettings
from cluster_est.shooting.carried_states import with_carried_states
from cluster_est.toml import dotted
from cluster_est.uncertainty import linearise
from workers.messages import FloatArray
from workers.messages.checks import check_kind, check_number

INVISIBLE = 1e-9
"""Size of a column, over the largest, below which it is rounding error."""


@dataclass(frozen=True)
class IdentifiableUnknown:
    """An unknown in the order of estimation.

    Attributes
    ----------
    unknown
        Position of the unknown in the space.
    size
        Root mean square of its scaled sensitivities, in sigmas.
    collinearity
        Collinearity index of this unknown with the estimated unknowns before it; infinite if the
        data cannot distinguish them.
    together
        Whether it can be estimated together with them.
    """

    unknown: int
    size: float
    collinearity: float
    together: bool


def identifiable_order(
    jacobian: FloatArray, changes: FloatArray, most: float
) -> list[IdentifiableUnknown]:
    """Order unknowns by their influence on the data in addition to the unknowns before them.

    Parameters
    ----------
    jacobian : (residuals, unknowns)
        Derivatives of the residuals.
    changes : (unknowns,)
        A noticeable change of each unknown.
    most
        Collinearity index from which unknowns cannot be estimated together.
    """
    tall = jacobian * changes
    rows = max(len(tall), 1)
    # R of a QR decomposition has few rows, and the same lengths and angles of columns
    scaled = np.linalg.qr(tall).R if len(tall) > tall.shape[1] else tall
    sizes = np.linalg.norm(scaled, axis=0)
    seen = sizes > INVISIBLE * sizes.max(initial=0.0)
    order = [] if not scaled.size else qr(scaled, mode="r", pivoting=True)[1].tolist()
    unit = scaled / np.where(seen, sizes, 1.0)
    found: list[IdentifiableUnknown] = []
    kept: list[int] = []
    for unknown in order:
        index = _collinearity(unit[:, [*kept, unknown]]) if seen[unknown] else np.inf
        together = index < most
        kept += [unknown] * together
        size = float(sizes[unknown] / np.sqrt(rows))
        found.append(IdentifiableUnknown(unknown, size, index, bool(together)))
    return found


def _collinearity(unit: FloatArray) -> float:
    """Return the collinearity index of columns of length 1."""
    smallest = float(np.linalg.svd(unit, compute_uv=False)[-1]) if len(unit) >= unit.shape[1] else 0
    return 1.0 / smallest if smallest > 0.0 else np.inf


POINTS_AT_ONCE, RESIDUALS_AT_ONCE = 1000, 20_000_000
"""Largest numbers of points, and of their residuals, that are requested together."""


@dataclass(frozen=True)
class Sensitivity(Study[SensitivityResult]):
    """A sensitivity analysis, which ranks unknowns by their influence between their bounds.

    Attributes
    ----------
    problem
        Model, parameters and experiments.
    settings
        Settings of the design and the indices.
    seed
        Random seed.
    """

    problem: Problem
    settings: SensitivitySettings = field(default_factory=SensitivitySettings)
    seed: int = 0

    @override
    def check(self) -> None:
        check_problem(self.problem)
        check_kind(self.settings, SensitivitySettings, "settings", ProblemError)
        check_number(self.seed, "sensitivity.seed", ProblemError, least=0, whole=True)
        self.problem.describe()
        check_bounds(self.problem)

    @override
    def run(self, environment: RunEnvironment) -> SensitivityResult:
        problem = with_carried_states(environment, self.problem)
        space = check_bounds(problem)
        with one_blas_thread(), environment.executor(problem) as executor:
            runner = environment.runner(executor, whole=True)
            return analyse_on(runner, space, self.settings, self.seed)


def analyse_sensitivity(
    problem: Problem,
    resources: Resources | Mapping[str, Any] | str | None = None,
    settings: SensitivitySettings | Mapping[str, Any] | None = None,
    seed: int = 0,
    *,
    progress: Show | bool | None = None,
    callback: Callback | None = None,
    record: Record | None = None,
) -> SensitivityResult:
    """Rank unknowns by how much they change the cost and the outputs between their bounds.

    Parameters
    ----------
    problem
        Model, parameters and experiments; the training experiments are simulated. Every unknown
        must have finite bounds.
    resources
        Where simulations run, and the budget.
    settings
        Settings of the design and the indices.
    seed
        Random seed; the result does not depend on the number of workers.
    progress, callback, record
        See `fit`.

    Raises
    ------
    ClusterEstError
        If model, experiments or resources are invalid, or if too few points can be simulated.
    """
    study = Sensitivity(prepared(problem), SensitivitySettings.of(settings), seed)
    return run_study(study, resources, progress=progress, callback=callback, record=record)


def analyse_on(
    runner: Runner, space: SearchSpace, settings: SensitivitySettings, seed: int
) -> SensitivityResult:
    """Analyse with existing workers.

    Parameters
    ----------
    runner
        Runs the simulations of the space's problem.
    space
        Search space from `check_bounds`.
    settings, seed
        Settings and random seed.

    Raises
    ------
    ProblemError
        If too few points can be simulated.
    """
    begin = time.monotonic()
    design, generator = DESIGNS[settings.method], np.random.default_rng(seed)
    reader = reader_of(space, settings.times)
    points = design.sample(space.size, settings.groups or design.usual, generator)
    runner.display.phase = "simulating between the bounds"
    values = _simulated(runner, space, points, reader, seed)
    kept = _whole_groups(values, design.group(space.size))
    groups = len(points) // design.group(space.size)
    lost = groups - int(kept.sum()) // design.group(space.size)
    if groups - lost < design.fewest:
        raise ProblemError(
            f"sensitivity: at least {design.fewest} groups of points must be simulated between the "
            f"bounds, but in {lost} of {groups} groups, a simulation failed or gave no finite cost "
            "or output; narrow the bounds of the parameters, or increase sensitivity.groups"
        )
    quantities, values = with_log_cost(reader.quantities, values[kept], space.problem.cost)
    found = [design.indices(points[kept], column, generator) for column in values.T]
    runner.display.phase = "finding what goes together"
    order, why_not = _order(runner, space, settings, seed)
    return SensitivityResult(
        problem=space.problem,
        settings=settings,
        seed=seed,
        ranks=f"{design.ranks} of {quantities[0].output}",
        ranking=_ranking(space, design, found[0], order),
        indices=_rows(space, quantities, found),
        groups=groups,
        lost=lost,
        evaluations=runner.evaluations,
        simulated=runner.simulations,
        failures=runner.failures,
        seconds=time.monotonic() - begin,
        why_no_order=why_not,
    )


def check_bounds(problem: Problem) -> SearchSpace:
    """Return the space of the training experiments, if it can be sampled.

    Raises
    ------
    ProblemError
        If there are no unknowns, or a bound is infinite.
    """
    problem = without_priors(problem)
    space = make_space(problem, problem.indices("train"))
    behind_gaps = {u.label: u.start for u in space.unknowns if u.parameter.per == "gap"}
    space = make_space(problem, problem.indices("train"), known=behind_gaps)
    if space.size == 0:
        raise ProblemError(
            "parameters: at least one must be free for a sensitivity analysis, but all are "
            "fixed or known; free one of them"
        )
    for unknown, low, high in zip(space.unknowns, space.lower, space.upper, strict=True):
        if not np.isfinite([low, high]).all():
            parameter = unknown.parameter
            above = unknown.log and parameter.lower <= 0.0
            must = "bounds above 0, because its scale is log," if above else "finite bounds"
            raise ProblemError(
                f"{_key_of(space, parameter.name)}: must be {must} between which a sensitivity "
                f"analysis can sample, but is [{parameter.lower:g}, {parameter.upper:g}]; change "
                "the bounds"
            )
    return space


def _key_of(space: SearchSpace, name: str) -> str:
    """Return the config key of a parameter's bounds."""
    effect, _, coefficient = name.rpartition(".")
    if effect in {each.name for each in space.problem.effects}:
        return f"effects.{effect}.{dotted('parameters', coefficient)}.bounds"
    return f"{dotted('parameters', name)}.bounds"


def _simulated(
    runner: Runner, space: SearchSpace, points: FloatArray, reader: PointReader, seed: int
) -> FloatArray:
    """Return the quantities at all points: (points, quantities); NaN if a simulation failed."""
    parts = []
    many = min(POINTS_AT_ONCE, max(1, RESIDUALS_AT_ONCE // max(space.rows[-1].stop, 1)))
    for first in range(0, len(points), many):
        unit = points[first : first + many]
        x = space.lower + unit * (space.upper - space.lower)
        request = SearchRequest("sample", GivenPoints(x, "sample"), space, seed)
        (solution,) = runner.run([request])
        parts.append(reader.values(solution.evaluations))
    return np.concatenate(parts)


def _whole_groups(values: FloatArray, group: int) -> np.ndarray:
    """Return a mask of the points in groups without failed points: (points,)."""
    finite = np.isfinite(values).all(axis=1).reshape(-1, group)
    return np.repeat(finite.all(axis=1), group)


def _order(
    runner: Runner, space: SearchSpace, settings: SensitivitySettings, seed: int
) -> tuple[list[IdentifiableUnknown], str]:
    """Return the order of estimation at the start values, or the reason why it is unknown."""
    request = SearchRequest("before", GivenPoints(space.start[None], "start"), space, seed)
    (solution,) = runner.run([request])
    linear = linearise(runner, space, solution)
    if linear.jacobian is None:
        return [], (
            "there is no order of estimation, because the model could not be simulated at the "
            "start values or close to them, or because the derivatives are too large for one array"
        )
    changes = np.minimum(space.typical, space.upper - space.lower)
    return identifiable_order(linear.jacobian, changes, settings.collinearity), ""


def _ranking(
    space: SearchSpace,
    design: SensitivityDesign,
    of_cost: Sequence[SensitivityIndex],
    order: Sequence[IdentifiableUnknown],
) -> tuple[RankedUnknown, ...]:
    """Return all unknowns, sorted by their influence on the cost."""
    (index,) = (each for each in of_cost if each.name == design.ranks)
    places = {each.unknown: (position, each) for position, each in enumerate(order)}
    found = []
    for i, unknown in enumerate(space.unknowns):
        one = RankedUnknown(unknown.label, float(index.values[i]), float(index.half_widths[i]))
        if i in places:
            position, each = places[i]
            one = replace(
                one,
                size=each.size,
                position=position,
                collinearity=each.collinearity,
                together=each.together,
            )
        found.append(one)
    return tuple(sorted(found, key=lambda u: -np.nan_to_num(u.value, nan=-np.inf)))


def _rows(
    space: SearchSpace,
    quantities: Sequence[AnalysedQuantity],
    found: Sequence[Sequence[SensitivityIndex]],
) -> tuple[IndexRow, ...]:
    return tuple(
        IndexRow(
            unknown.label, index.name, quantity.output, quantity.experiment, quantity.time,
            float(index.values[i]), float(index.half_widths[i]),
        )
        for quantity, indices in zip(quantities, found, strict=True)
        for index in indices
        for i, unknown in enumerate(space.unknowns)
    )  # fmt: skip
