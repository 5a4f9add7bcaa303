"""The rows of a fit's tables: estimates, constraints, starts and minima."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cluster_est.methods.method import TOLERANCE, OtherPoint, Solution
from cluster_est.problem import display
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.unknowns import scope_of
from cluster_est.results.output_errors import Simulation
from cluster_est.results.tables.row_types import ConstraintValue, Estimate, PointValue, StartResult
from cluster_est.running.multistart import MultistartResult
from cluster_est.running.search_state import assemble_evaluation
from cluster_est.statistics.residual_findings import ResidualDiagnostics
from cluster_est.uncertainty import ConfidenceInterval, Uncertainty
from workers.fmu.description import describe_model
from workers.messages import FloatArray


def estimates(
    space: SearchSpace,
    solution: Solution,
    role: str,
    units: dict[str, str],
    found: Sequence[ConfidenceInterval],
) -> list[Estimate]:
    """The values that were searched for, with their intervals."""
    steps = solution.difference_steps
    return [
        _estimate(
            space,
            solution,
            i,
            found[i],
            role=role,
            units=units,
            difference_step=np.nan if steps is None else steps[i],
        )
        for i in range(space.size)
    ]


def _estimate(
    space: SearchSpace,
    solution: Solution,
    i: int,
    interval: ConfidenceInterval,
    *,
    role: str,
    units: dict[str, str],
    difference_step: float,
) -> Estimate:
    unknown = space.unknowns[i]
    parameter = unknown.parameter
    return Estimate(
        label=unknown.label,
        parameter=parameter.name,
        variable=parameter.target,
        unit=parameter.unit or units.get(parameter.target, ""),
        scope=unknown.scope or "shared",
        value=unknown.to_physical(float(solution.x[i])),
        start=unknown.start,
        lower=parameter.lower,
        upper=parameter.upper,
        scale=parameter.scale,
        at_bound=interval.at_bound,
        std_error=interval.std_error,
        lower95=interval.lower95,
        upper95=interval.upper95,
        error_white=interval.error_white,
        error_autoregression=interval.error_autoregression,
        error_experiments=interval.error_experiments,
        difference_step=float(difference_step),
        estimated_on=role,
    )


def derived(
    space: SearchSpace, solution: Solution, units: dict[str, str], uncertainty: Uncertainty
) -> list[Estimate]:
    """Parameters that follow from the estimates, with intervals to first order."""
    rows = []
    spread = {each.label: each for each in uncertainty.derived}
    parameters = {p.name: p for p in space.problem.parameters}
    for label, value in space.derived(solution.x).items():
        name = label if label in parameters else label.rpartition("[")[0]
        known = _known(parameters[name], units, value, "derived")
        known = replace(known, label=label, scope=scope_of(label, name) or "shared")
        if (each := spread.get(label)) is not None:
            known = replace(
                known, std_error=each.std_error, lower95=each.lower95, upper95=each.upper95
            )
        rows.append(known)
    return rows


def fixed(problem: Problem, units: dict[str, str]) -> list[Estimate]:
    """Parameters that were kept at their starts."""
    return [_known(p, units, p.start, "known") for p in problem.parameters if p.fixed]


def _known(parameter: Parameter, units: dict[str, str], value: float, how: str) -> Estimate:
    """A row for what was not searched for."""
    return Estimate(
        label=parameter.name,
        parameter=parameter.name,
        variable=parameter.target,
        unit=parameter.unit or units.get(parameter.target, ""),
        scope="shared",
        value=value,
        start=parameter.start,
        lower=parameter.lower,
        upper=parameter.upper,
        scale=parameter.scale,
        at_bound="",
        std_error=np.nan,
        lower95=np.nan,
        upper95=np.nan,
        error_white=np.nan,
        error_autoregression=np.nan,
        error_experiments=np.nan,
        difference_step=np.nan,
        estimated_on=how,
    )


def constraints(
    space: SearchSpace, solution: Solution, before: list[Simulation], after: list[Simulation]
) -> tuple[ConstraintValue, ...]:
    """Every constraint on the training experiments, at the start and at the estimates."""
    if not space.constraint_names:
        return ()
    then, now = (
        _judged(space, x, each) for x, each in ((space.start, before), (solution.x, after))
    )
    rows = []
    for i, name in enumerate(space.constraint_names):
        equal = bool(space.equality[i])
        value = float(now[i])
        kept = (abs(value) if equal else value) <= TOLERANCE
        kind = "= 0" if equal else "<= 0"
        rows.append(ConstraintValue(name, kind, float(then[i]), value, kept))
    return tuple(rows)


def constraints_at_start(space: SearchSpace, simulations: list[Simulation]) -> tuple[float, ...]:
    """Every constraint on the training experiments at the start, over its scale."""
    return tuple(_judged(space, space.start, simulations).tolist())


def _judged(space: SearchSpace, x: FloatArray, simulations: list[Simulation]) -> FloatArray:
    """The constraints at x, NaN where a simulation failed."""
    outcomes = tuple(simulations[e].outcome for e in space.experiments)
    found = assemble_evaluation(space, x, outcomes, 0).constraints
    return found if len(found) else np.full(len(space.constraint_names), np.nan)


def starts_and_minima(
    space: SearchSpace, found: MultistartResult
) -> tuple[tuple[StartResult, ...], tuple[PointValue, ...]]:
    """Rows of several starts and their minima; none where there was one start."""
    if len(found.solutions) < 2:
        return (), ()
    numbered = enumerate(zip(found.solutions, found.minimum, strict=True))
    starts = tuple(
        StartResult(i, s.cost, s.ending.name.lower(), s.iterations, minimum)
        for i, (s, minimum) in numbered
    )
    minima = [OtherPoint(found.solutions[i].x, found.solutions[i].cost) for i in found.minima]
    return starts, points(space, tuple(minima))


def points(space: SearchSpace, others: tuple[OtherPoint, ...]) -> tuple[PointValue, ...]:
    """Points worth keeping, value by value."""
    return tuple(
        PointValue(i, label, value, other.cost, other.objectives)
        for i, other in enumerate(others)
        for label, value in space.estimates(other.x).items()
    )


def coefficient_units(problem: Problem) -> dict[str, str]:
    """Units of the effects' coefficients, by "EFFECT.COEFFICIENT"; "" where the FMU names none."""
    if not problem.effects:
        return {}
    from workers.effects import definition as effects  # SymPy takes long to import

    model = problem.model
    description = describe_model(model)
    found: dict[str, str] = {}
    for definition in effects.define_all(
        problem.effects, description, model.interface, problem.experiments
    ):
        names = [f"{definition.effect.name}.{c.name}" for c in definition.form.coefficients]
        texts = effects.coefficient_units(definition, description)
        pairs = zip(names, texts, strict=True)
        found |= {name: "" if effects.UNKNOWN in unit else unit for name, unit in pairs}
    return found


def fit_tables(
    estimates: Sequence[Estimate],
    errors: Sequence[Any],
    diagnostics: ResidualDiagnostics | None = None,
) -> tuple[display.DisplayTable, display.DisplayTable]:
    """Estimates and errors, of a fit or of a closed loop, as a notebook shows them.

    Where diagnostics deny the intervals, a word beside them says so.
    """
    too_narrow = diagnostics is not None and diagnostics.too_narrow
    ends = ("95 % from", "to (too narrow)" if too_narrow else "to")
    values = [
        (e.label, e.value, e.unit, e.std_error, e.lower95, e.upper95, e.at_bound) for e in estimates
    ]
    fits = [(e.experiment, e.role, e.output, e.rmse_before, e.rmse_after, e.unit) for e in errors]
    return (
        display.DisplayTable(
            "Parameters",
            ("parameter", "value", "unit", "standard error", *ends, "at bound"),
            values,
        ),
        display.DisplayTable(
            "Root mean square errors",
            ("experiment", "role", "output", "before", "after", "unit"),
            fits,
        ),
    )
