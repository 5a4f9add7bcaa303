"""The recipe of a sensitivity analysis: sample the bounds, simulate, compute indices, order.

Indices say how much an unknown moves the cost and the outputs between its bounds: A. Saltelli et
al., Global Sensitivity Analysis: The Primer (2008), doi:10.1002/9780470725184.

The order says which unknowns can be estimated together, by local sensitivities S = J D: derivatives
of the residuals by the unknowns, times a noticeable change of each. The size of a column is how
much the data see of an unknown; columns that are nearly dependent belong to unknowns that can make
up for each other. The collinearity index 1 / sqrt(smallest eigenvalue of N'N), N the columns scaled
to length 1, is how many times larger a change of the best combination is than what is left of it:
R. Brun, P. Reichert, H. R. Kuensch, Water Resour. Res. 37 (2001) 1015-1030,
doi:10.1029/2000WR900350. The order is that of a QR decomposition with column pivoting: M. Burth,
G. C. Verghese, M. Velez-Reyes, IEEE Trans. Power Syst. 14 (1999) 218-225, doi:10.1109/59.744536.
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
"""Size of a column, over the largest, that counts as none: below it differences are rounding."""


@dataclass(frozen=True)
class IdentifiableUnknown:
    """An unknown, in the order in which they are best estimated.

    Attributes
    ----------
    unknown
        Its position in the space.
    size
        Root mean square of its scaled sensitivities, in sigmas.
    collinearity
        Index of this unknown with those before it that are estimated; infinite where it cannot be
        told from them.
    together
        It may be estimated together with them.
    """

    unknown: int
    size: float
    collinearity: float
    together: bool


def identifiable_order(
    jacobian: FloatArray, changes: FloatArray, most: float
) -> list[IdentifiableUnknown]:
    """Order unknowns by what the data see of each beyond those before it.

    Parameters
    ----------
    jacobian : (residuals, unknowns)
        At the point that they are judged at.
    changes : (unknowns,)
        A noticeable change of each.
    most
        Collinearity index from which on unknowns cannot be estimated together.
    """
    tall = jacobian * changes
    rows = max(len(tall), 1)
    # R of a QR decomposition has the columns' lengths and angles, and few rows
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
    """The index of columns of length 1."""
    smallest = float(np.linalg.svd(unit, compute_uv=False)[-1]) if len(unit) >= unit.shape[1] else 0
    return 1.0 / smallest if smallest > 0.0 else np.inf


POINTS_AT_ONCE, RESIDUALS_AT_ONCE = 1000, 20_000_000
"""Points that are asked for together, and their residuals: only the quantities are kept."""


@dataclass(frozen=True)
class Sensitivity(Study[SensitivityResult]):
    """The ranking of unknowns by how much they matter between their bounds.

    Attributes
    ----------
    problem
        Model, parameters and experiments.
    settings
        Design, and what is computed from it.
    seed
        Starts the random generator.
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
    """Rank unknowns by how much they move the cost and the outputs within their bounds.

    Parameters
    ----------
    problem
        Model, parameters and experiments; the training experiments are simulated. Every unknown
        needs finite bounds: what is asked is how much it matters between them.
    resources
        Where simulations run, and the budget.
    settings
        Design, and what is computed from it.
    seed
        Starts the random generator; the result is the same for any number of workers.
    progress, callback, record
        As for `fit`.

    Raises
    ------
    ClusterEstError
        If model, experiments and machine do not fit together, or too few points can be simulated.
    """
    study = Sensitivity(prepared(problem), SensitivitySettings.of(settings), seed)
    return run_study(study, resources, progress=progress, callback=callback, record=record)


def analyse_on(
    runner: Runner, space: SearchSpace, settings: SensitivitySettings, seed: int
) -> SensitivityResult:
    """Analyse on workers that are there already.

    Parameters
    ----------
    runner
        Its executor has the experiments of the space's problem.
    space
        As `check_bounds` gave it.
    settings, seed
        How.

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
        If there is nothing to sample, or a bound is infinite.
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
    """The key of a parameter's bounds in a config."""
    effect, _, coefficient = name.rpartition(".")
    if effect in {each.name for each in space.problem.effects}:
        return f"effects.{effect}.{dotted('parameters', coefficient)}.bounds"
    return f"{dotted('parameters', name)}.bounds"


def _simulated(
    runner: Runner, space: SearchSpace, points: FloatArray, reader: PointReader, seed: int
) -> FloatArray:
    """(points, quantities): NaN where a simulation failed."""
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
    """(points,): whether no point of the same group has failed."""
    finite = np.isfinite(values).all(axis=1).reshape(-1, group)
    return np.repeat(finite.all(axis=1), group)


def _order(
    runner: Runner, space: SearchSpace, settings: SensitivitySettings, seed: int
) -> tuple[list[IdentifiableUnknown], str]:
    """The order of estimation at the start values, or the reason why it is unknown."""
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
    """All unknowns, the one that moves the cost the most first."""
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
