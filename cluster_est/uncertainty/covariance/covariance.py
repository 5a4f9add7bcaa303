"""Standard errors, intervals and correlations from the Jacobian at the solution.

With residuals r of n numbers that determine k directions, the covariance is s^2 (J'J)^-1 with
s^2 = r'r / (n - k), and the intervals are those of Student's t: G. A. F. Seber, C. J. Wild,
Nonlinear Regression (1989), doi:10.1002/0471725315, section 2.1. For other costs see `system`.

That is right where the residuals are independent. Where they are not, the covariance is that of an
autoregression for each output, or of the scatter of the experiments (see `noise_covariance`). All
of it takes the model for nearly linear over the interval: where it bends, or an interval reaches a
bound, take profiles. Nothing here allows for a model that lacks something.

A bound that an unknown is at removes a direction, and so does an active constraint on parameters,
whose gradient is projected out. Active constraints on signals are ignored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import chain

import numpy as np
from scipy.special import stdtrit

from cluster_est.methods.method import Solution
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.search_space import SearchSpace
from cluster_est.uncertainty.covariance.local_uncertainty import (
    ConfidenceInterval,
    DerivedInterval,
    Uncertainty,
    joined,
)
from cluster_est.uncertainty.covariance.noise_covariance import (
    NoiseBasis,
    coloured_covariances,
    most_honest,
)
from cluster_est.uncertainty.covariance.normal_equations import (
    DETERMINED_BY_CONSTRAINTS,
    ActiveBound,
    BlockCovariance,
    UnknownLayout,
    active_bounds,
    has_jacobian,
    jacobian_blocks,
    unknown_layout,
)
from cluster_est.uncertainty.covariance.system import (
    WEAK,
    ScaledJacobian,
    directions,
    factorised_jacobian,
)
from workers.messages import FloatArray


def intervals(space: SearchSpace, solution: Solution) -> list[ConfidenceInterval]:
    """Return an interval for each unknown; see `assess`."""
    return list(assess(space, solution).intervals)


def assess(
    space: SearchSpace, solution: Solution, measured_step: float | FloatArray = 0.0
) -> Uncertainty:
    """Return the uncertainty of a solution from its Jacobian, without simulations.

    Parameters
    ----------
    space, solution
        The space that was searched, and the solution with its `jacobian` and, for any cost but the
        sum of squares, `at`. See `linearise` where a method leaves none.
    measured_step
        The second result of `sharpen`, if it was called.
    """
    system = scaled_jacobian(space, solution, measured_step)
    if system is None:
        return not_assessed(space, solution)
    return _report(space, solution.x, system)


def scaled_jacobian(
    space: SearchSpace,
    solution: Solution,
    measured_step: float | FloatArray = 0.0,
    weak: float = WEAK,
) -> ScaledJacobian | None:
    """Return the factorised Jacobian of a solution; None if a part of it or its values lack."""
    has_values = solution.at is not None or isinstance(space.problem.cost, SumSquared)
    known = has_jacobian(solution) and not _without_derivative(space, solution)
    if not known or not has_values or not np.isfinite(solution.cost):
        return None
    constraints = np.zeros(0) if solution.at is None else solution.at.constraints
    jacobian = jacobian_blocks(space, solution)
    layout = unknown_layout(space, solution.x, constraints, jacobian=jacobian)
    unbounded = unknown_layout(space, solution.x, constraints, held=False)
    return factorised_jacobian(
        space, solution, (layout, unbounded), measured_step=measured_step, weak=weak
    )


def _without_derivative(space: SearchSpace, solution: Solution) -> list[str]:
    """The unknowns for which simulations beside the solution failed; 0 is not their derivative."""
    if solution.frozen is None:
        return []
    return [space.unknowns[i].label for i in np.flatnonzero(solution.frozen)]


def not_assessed(space: SearchSpace, solution: Solution, why: str = "") -> Uncertainty:
    """Return the uncertainty of a solution of which none is known, with the reason.

    Parameters
    ----------
    space, solution
        As for `assess`.
    why
        The reason; that derivatives are missing, if it is left out.
    """
    bounds = active_bounds(space, solution.x)
    found = tuple(ConfidenceInterval(np.nan, np.nan, np.nan, bound) for bound in bounds)
    names = _without_derivative(space, solution)
    if not why and names and has_jacobian(solution):
        why = f"simulations for the derivatives with respect to {joined(names)} failed"
    why = why or "no derivatives are known at the solution"
    note = f"there are no intervals, because {why}"
    none = np.zeros((0, 0))
    return Uncertainty(found, (), (), (), none, none, (), np.nan, 0, (note,))


def _report(space: SearchSpace, x: FloatArray, system: ScaledJacobian) -> Uncertainty:
    white = system.covariance
    no_law = space.hidden_values or space.has_ordinal_values
    coloured = () if no_law else coloured_covariances(white, system.factors, system.residuals)
    covariances = (white, *coloured)
    layout, chosen = system.layout, most_honest(covariances)
    width = float(stdtrit(chosen.degrees, 0.975)) if chosen.degrees > 0 else np.nan
    scaled = np.sqrt(_diagonal(space, system, chosen.blocks))
    errors = {
        each.basis: np.sqrt(_diagonal(space, system, each.blocks)) / system.scale
        for each in covariances
    }
    uniform = np.full(space.size, np.nan)
    if system.uniform is not None:
        uniform = np.sqrt(_diagonal(space, system, system.uniform.blocks)) / system.scale
    shared, local = layout.shared, np.array([*chain(*layout.local)], dtype=np.intp)
    within = system.coordinates @ chosen.blocks.shared @ system.coordinates.T
    crossed = [part @ system.coordinates.T for part in chosen.blocks.cross]
    across = np.vstack([np.zeros((0, len(shared))), *crossed])
    with np.errstate(invalid="ignore", divide="ignore"):
        correlations = within / np.outer(scaled[shared], scaled[shared])
        mixed = across / np.outer(scaled[local], scaled[shared])
    return Uncertainty(
        intervals=tuple(
            _interval(
                space, x, i, errors, uniform, basis=chosen.basis, width=width, at_bound=at_bound
            )
            for i, at_bound in enumerate(layout.active_bounds)
        ),
        derived=_derived(space, x, system, chosen.blocks, width),
        shared=tuple(space.unknowns[i].label for i in shared),
        local=tuple(space.unknowns[i].label for i in local),
        correlations=correlations,
        local_correlations=mixed,
        directions=directions(space, x, system),
        variance=system.scatter.variance,
        degrees=system.scatter.degrees,
        notes=(*_notes(layout, system), *_noise_notes(layout, system, errors, chosen.basis)),
        basis=chosen.basis,
        basis_degrees=chosen.degrees,
    )


def _diagonal(
    space: SearchSpace, system: ScaledJacobian, covariance: BlockCovariance
) -> FloatArray:
    """Return the diagonal (unknowns,); NaN where held or part of an undetermined direction."""
    result = np.full(space.size, np.nan)
    shared, coordinates = system.layout.shared, system.coordinates
    inside = ((coordinates @ covariance.shared) * coordinates).sum(axis=1)
    free = np.linalg.norm(coordinates, axis=1) > DETERMINED_BY_CONSTRAINTS
    result[shared] = np.where(free, inside, np.nan)
    for local, part in zip(system.layout.local, covariance.local, strict=True):
        result[local] = np.diag(part)
    affected = (np.abs(system.undetermined) > system.tolerance).any(axis=0)
    return np.where(affected | (result < 0.0), np.nan, result)


def _interval(
    space: SearchSpace,
    x: FloatArray,
    i: int,
    errors: Mapping[NoiseBasis, FloatArray],
    uniform: FloatArray,
    *,
    basis: NoiseBasis,
    width: float,
    at_bound: ActiveBound,
) -> ConfidenceInterval:
    unknown, error = space.unknowns[i], float(errors[basis][i])
    finite = bool(np.isfinite(error)) and np.isfinite(width)
    low = unknown.to_physical(float(x[i] - width * error)) if finite else np.nan
    high = unknown.to_physical(float(x[i] + width * error)) if finite else np.nan
    unit = unknown.to_physical(float(x[i])) if unknown.log else 1.0
    physical = [unit * float(errors[b][i]) if b in errors else np.nan for b in NoiseBasis]
    found = ConfidenceInterval(unit * error, low, high, at_bound, *physical)
    known = np.isfinite(uniform[i])
    return replace(found, error_uniform=unit * float(uniform[i])) if known else found


def _derived(
    space: SearchSpace,
    x: FloatArray,
    system: ScaledJacobian,
    covariance: BlockCovariance,
    width: float,
) -> tuple[DerivedInterval, ...]:
    """Return intervals by the delta method, without pairs of experiments' local unknowns."""
    values = space.derived(x)
    if not values:
        return ()
    gradients = {label: np.zeros(space.size) for label in values}
    for i in range(space.size):  # held ones too: they may be in undetermined directions
        step = np.cbrt(np.finfo(float).eps) * max(abs(float(x[i])), float(space.typical[i]))
        x_plus, x_minus = x.copy(), x.copy()
        x_plus[i] = min(x[i] + step, space.upper[i])
        x_minus[i] = max(x[i] - step, space.lower[i])
        plus, minus = space.derived(x_plus), space.derived(x_minus)
        for label in values:
            # a value that is the same in all experiments may be so at x alone, by chance
            change = plus.get(label, np.nan) - minus.get(label, np.nan)
            gradients[label][i] = change / (x_plus[i] - x_minus[i])
    found = []
    for label, value in values.items():
        error = _delta_method_error(system, covariance, gradients[label] / system.scale)
        half = width * error
        found.append(DerivedInterval(label, value, error, value - half, value + half))
    return tuple(found)


def _delta_method_error(
    system: ScaledJacobian, covariance: BlockCovariance, gradient: FloatArray
) -> float:
    """Return the standard error of a function with this gradient by scaled unknowns."""
    lengths = np.linalg.norm(system.undetermined, axis=1) * np.linalg.norm(gradient)
    if (np.abs(system.undetermined @ gradient) > system.tolerance * lengths).any():
        return np.nan
    own = system.coordinates.T @ gradient[system.layout.shared]
    total = float(own @ covariance.shared @ own)
    parts = zip(system.layout.local, covariance.cross, covariance.local, strict=True)
    for local, cross, block in parts:
        part = gradient[local]
        total += 2.0 * float(part @ cross @ own) + float(part @ block @ part)
    return float(np.sqrt(np.maximum(total, 0.0)))


def _notes(layout: UnknownLayout, system: ScaledJacobian) -> tuple[str, ...]:
    notes = []
    if system.weighting.problem:
        notes.append(f"there are no intervals, because {system.weighting.problem}; use bootstrap")
    elif system.scatter.degrees <= 0:
        count = len(system.weighting.factor)
        rank = system.factors.rank
        notes.append(
            f"there are no intervals, because {count} residuals determine {rank} independent "
            "combinations of the parameters, so no residual is left to estimate the noise; add "
            "measurements, or fix some parameters"
        )
    if layout.active:
        names = ", ".join(repr(name) for name in layout.active)
        notes.append(
            "the intervals allow only those changes of the parameters that keep these constraints "
            f"active: {names}"
        )
    if layout.ignored:
        names = ", ".join(repr(name) for name in layout.ignored)
        notes.append(
            f"the intervals ignore active constraints on signals ({names}); profiles respect "
            "these constraints"
        )
    return tuple(notes)


def _noise_notes(
    layout: UnknownLayout,
    system: ScaledJacobian,
    errors: Mapping[NoiseBasis, FloatArray],
    basis: NoiseBasis,
) -> tuple[str, ...]:
    """Say what the intervals allow for, and by how much, where the noise is not white."""
    if basis is NoiseBasis.WHITE:
        return ()
    chosen = layout.shared if basis is NoiseBasis.EXPERIMENTS else slice(None)
    ratios = errors[basis][chosen] / errors[NoiseBasis.WHITE][chosen]
    known = ratios[np.isfinite(ratios)]
    if not len(known):
        return ()
    least, most = (f"{value:.2g}" for value in (known.min(), known.max()))
    times = most if least == most else f"{least} to {most}"
    if basis is NoiseBasis.AUTOREGRESSION:
        return (
            "the residuals are autocorrelated, and the intervals account for this: the standard "
            f"errors are {times} times as large as with white noise",
        )
    return (
        f"the {len(system.factors.parts)} experiments differ by more than their noise explains, "
        f"so the intervals are computed from these differences: the standard errors are {times} "
        "times as large as with white noise",
    )
