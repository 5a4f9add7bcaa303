"""Standard errors, intervals and correlations from the Jacobian at the solution.

If n residuals r determine k directions, the covariance is s^2 (J'J)^-1 with s^2 = r'r / (n - k).
The intervals are those of Student's t (G. A. F. Seber, C. J. Wild, Nonlinear Regression (1989),
doi:10.1002/0471725315, section 2.1). For other costs, see `system`.

This is correct for independent residuals. Otherwise, the covariance is that of an autoregression
for each output, or of the scatter of the experiments (see `noise_covariance`). All of these assume
a nearly linear model within the interval. Use profiles if the model is nonlinear there, or if an
interval reaches a bound. The intervals do not allow for effects that the model lacks.

An unknown at a bound removes a direction, and so does an active constraint on parameters, whose
gradient is projected out. Active constraints on signals are ignored.
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
    MORE_SAMPLES,
    ConfidenceInterval,
    DerivedInterval,
    Uncertainty,
    joined,
)
from cluster_est.uncertainty.covariance.noise_covariance import (
    EstimateCovariance,
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

WIDE = 1.5
"""Width of an interval, over its width with many samples, above which the reason is given."""


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
        The search space, and the solution with `jacobian` and, for any cost except the sum of
        squares, `at`. If they are missing, use `linearise` first.
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
    """Return the factorised Jacobian of a solution; None if derivatives or values are missing."""
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
    """Return the unknowns without derivatives, because simulations near the solution failed."""
    if solution.frozen is None:
        return []
    return [space.unknowns[i].label for i in np.flatnonzero(solution.frozen)]


def not_assessed(space: SearchSpace, solution: Solution, why: str = "") -> Uncertainty:
    """Return an unknown uncertainty, with the reason.

    Parameters
    ----------
    space, solution
        See `assess`.
    why
        The reason; by default, that derivatives are missing.
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
        notes=(
            *_notes(layout, system),
            *_noise_notes(layout, system, errors, chosen.basis),
            *_wide_notes(system, chosen, width),
        ),
        basis=chosen.basis,
        basis_degrees=chosen.degrees,
    )


def _diagonal(
    space: SearchSpace, system: ScaledJacobian, covariance: BlockCovariance
) -> FloatArray:
    """Return the diagonal (unknowns,); NaN for unknowns that are held or not determined."""
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
    """Return intervals from the delta method, without covariances of local unknowns."""
    values = space.derived(x)
    if not values:
        return ()
    gradients = {label: np.zeros(space.size) for label in values}
    for i in range(space.size):  # also for held unknowns, which undetermined directions may contain
        step = np.cbrt(np.finfo(float).eps) * max(abs(float(x[i])), float(space.typical[i]))
        x_plus, x_minus = x.copy(), x.copy()
        x_plus[i] = min(x[i] + step, space.upper[i])
        x_minus[i] = max(x[i] - step, space.lower[i])
        plus, minus = space.derived(x_plus), space.derived(x_minus)
        for label in values:
            # the label may be missing at the other points: values may be equal only at x, by chance
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
    """Return the standard error of a function with this gradient in scaled unknowns."""
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


def _wide_notes(
    system: ScaledJacobian, chosen: EstimateCovariance, width: float
) -> tuple[str, ...]:
    """Return a note if few residuals remain to estimate the noise, so that intervals are wide."""
    wider = width / float(stdtrit(np.inf, 0.975))
    if not wider >= WIDE:
        return ()
    count, rank = len(system.weighting.factor), system.factors.rank
    correlated = chosen.basis is NoiseBasis.AUTOREGRESSION
    return (
        f"the intervals are {wider:.2g} times as wide as with many independent residuals, because "
        f"{count} {'autocorrelated ' if correlated else ''}residuals determine {rank} values, "
        f"which leaves {chosen.degrees:.2g} degree{'' if chosen.degrees == 1 else 's'} of freedom "
        f"to estimate their size{MORE_SAMPLES}",
    )


def _noise_notes(
    layout: UnknownLayout,
    system: ScaledJacobian,
    errors: Mapping[NoiseBasis, FloatArray],
    basis: NoiseBasis,
) -> tuple[str, ...]:
    """Return a note on the noise model of the intervals, if the noise is not white."""
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
