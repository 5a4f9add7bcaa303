"""Jacobians and gradients, from sensitivities of the model or from finite differences.

A worker computes the derivatives of the residuals by the physical values (see
`workers.simulation.sensitivities`). The chain rule gives the derivatives by the unknowns. An FMU's
directional derivatives may be wrong. So the first Jacobian is checked against a central difference
along one direction, in which all relevant unknowns change the residuals equally. Differences are
used if the sensitivities are wrong, or if the model has none.

If the cost gives weights w to the residuals r, its gradient is 2 J'(w r). It is exact except for
the differences in J, and needs one point for each colour of unknowns. Differences of the cost
itself lose twice as many digits near a minimum. They need a point for each unknown, because a
coloured point mixes the changes of several unknowns.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.differences import (
    STEP_PARTS,
    Differences,
    Neighbours,
    ResidualJacobian,
    Scheme,
    difference_steps,
    jacobian,
    relative_noise,
    suitable_step,
)
from cluster_est.methods.method import Evaluation, Points, Progress
from cluster_est.problem.search_space import SearchSpace
from workers.messages import FloatArray

CHAIN_STEP = 6e-6
"""Relative step of the derivatives of physical values by unknowns; the formulas have no noise."""
LENGTHENING = 10.0
"""Factor of longer difference steps, for simulations with more noise than the solver suggests."""
LONGEST_DIFFERENCE_STEP = 0.03
"""Longest relative step of differences; longer steps have a large truncation error."""
SENSITIVITY_AGREEMENT = 1e-3
"""Largest relative error of the residuals' changes in the check of sensitivities."""
LEAST_EFFECT = 1e-3
"""Lower limit of an unknown's effect in the check, relative to the largest effect."""

JacobianRequests = Generator[Points, list[Evaluation], ResidualJacobian]


class JacobianProvider:
    """The source of a search's Jacobians: forward sensitivities or differences.

    Parameters
    ----------
    differences
        Option of the method. "sensitivities" uses the model's forward sensitivities, and is "auto"
        if the model has none.
    space, relative_step
        The search space, and the relative step of the differences; 0 selects it automatically.

    Attributes
    ----------
    scheme
        Scheme of the differences; None while sensitivities are used.
    note
        Message about the use of differences, for the user; may be "".
    """

    def __init__(self, space: SearchSpace, differences: Differences, relative_step: float) -> None:
        self._space, self._relative_step = space, relative_step
        self._automatic = differences in ("auto", "sensitivities")
        self._checked = False
        self.scheme: Scheme | None = "central" if differences == "central" else "forward"
        if differences == "sensitivities":
            self.scheme = None
        self.note = ""
        self._longer = 1.0

    @property
    def exact(self) -> bool:
        """True if no more accurate derivatives are available."""
        return self.scheme != "forward"

    def refine(self) -> bool:
        """Change from forward to central differences, if allowed; return whether it changed."""
        if not self._automatic or self.exact:
            return False
        self.scheme = "central"
        return True

    def lengthen(self) -> bool:
        """Lengthen the difference steps, if allowed; return whether they changed.

        Use it for simulations with more noise than the solver's tolerance suggests.
        """
        relative = self._relative(LENGTHENING * self._longer)
        if not self._automatic or self._relative_step > 0.0 or self.scheme is None:
            return False
        if relative > LONGEST_DIFFERENCE_STEP:
            return False
        self._longer *= LENGTHENING
        self.note = (
            f"the finite differences used relative steps of {relative:.1g}, because shorter steps "
            "were unreliable: either the simulations are noisy, or the cost has a kink"
        )
        return True

    def _relative(self, longer: float) -> float:
        """Return the relative step: the user's, or the step from the noise times `longer`."""
        if self._relative_step > 0.0:
            return self._relative_step
        return longer * suitable_step(self._space, self.scheme or "central")

    def jacobian(
        self, scaled: SearchSpace, x: FloatArray, at: Evaluation, progress: Progress | None
    ) -> JacobianRequests:
        """Compute a Jacobian; `scaled` is the space with the sizes for central differences."""
        if self.scheme is None:
            found = yield from forward_sensitivities(self._space, x, at, progress)
            if isinstance(found, ResidualJacobian) and not self._checked:
                self._checked = True
                found = (yield from check_sensitivities(self._space, x, found)) or found
            if isinstance(found, ResidualJacobian):
                return found
            self.note = f"finite differences were used instead of sensitivities: {found.reason}"
            self.scheme = "forward"
        space = scaled if self.scheme == "central" else self._space
        relative = self._relative(self._longer)
        return (yield from jacobian(space, x, at, self.scheme, relative, progress))


@dataclass(frozen=True)
class UnusableSensitivities:
    """The reason why the sensitivities of a model are missing or wrong."""

    reason: str


def forward_sensitivities(
    space: SearchSpace, x: FloatArray, at: Evaluation, progress: Progress | None
) -> Generator[Points, list[Evaluation], ResidualJacobian | UnusableSensitivities]:
    """Evaluate one point with sensitivities and return their Jacobian."""
    (found,) = yield Points(x[None, :], "sensitivities", progress, sensitivities=True)
    constraints = np.zeros((len(space.constraint_names), space.size))
    on_parameters = space.parameter_constraint_jacobian(x)
    constraints[: len(on_parameters)] = on_parameters
    given: list[FloatArray] = []
    for outcome in found.outcomes:
        if outcome.sensitivities is None:
            return UnusableSensitivities(outcome.message)
        given.append(outcome.sensitivities)
    blocks = []
    for e, dp_dx in enumerate(_physical_derivatives(space, x)):
        used = np.flatnonzero(dp_dx.any(axis=1))
        dr_dp = given[e][:, used]
        if not np.isfinite(dr_dp).all():
            bad = used[np.flatnonzero(~np.isfinite(dr_dp).all(axis=0))[0]]
            name = space.problem.model.parameters[bad]
            return UnusableSensitivities(
                f"the model has no finite derivatives with respect to {name!r}"
            )
        dr_dx, priors = dr_dp @ dp_dx[used], space.priors.jacobian(e, x, space.acting[e])
        count = at.rows[e].stop - at.rows[e].start - len(priors)
        blocks.append(np.vstack([dr_dx[:count], priors]))
        constraints[space.constraint_rows[e], space.acting[e]] = dr_dx[count:]
    matrix = BlockMatrix(tuple(blocks), space.acting, space.size)
    steps = difference_steps(space, x, "central", 0.0)
    return ResidualJacobian(matrix, np.zeros(space.size, bool), steps, constraints)


def _physical_derivatives(space: SearchSpace, x: FloatArray) -> list[FloatArray]:
    """Return d physical / d x for each experiment: (parameters, unknowns that act on it)."""
    steps = CHAIN_STEP * np.where(x == 0.0, 1.0, np.maximum(np.abs(x), 1e-3 * space.typical))
    factors = [np.zeros((len(space.problem.model.parameters), len(c))) for c in space.acting]
    colour_of = np.zeros(space.size, np.intp)
    by_colour = []
    for colour, members in enumerate(space.colours):
        colour_of[members] = colour
        plus, minus = x.copy(), x.copy()
        plus[members] = np.minimum(x[members] + steps[members], space.upper[members])
        minus[members] = np.maximum(x[members] - steps[members], space.lower[members])
        by_colour.append((space.physical(plus) - space.physical(minus), plus - minus))
    for e, columns in enumerate(space.acting):
        for j, i in enumerate(columns.tolist()):
            change, widths = by_colour[colour_of[i]]
            if widths[i] > 0.0:
                factors[e][:, j] = change[e] / widths[i]
    return factors


def check_sensitivities(
    space: SearchSpace, x: FloatArray, found: ResidualJacobian
) -> Generator[Points, list[Evaluation], UnusableSensitivities | None]:
    """Compare a Jacobian with a difference along one direction; return the error, if any."""
    x_plus, x_minus = _check_points(space, x, found)
    plus, minus = yield Points(np.vstack([x_plus, x_minus]), "sensitivities_check")
    if not (plus.ok and minus.ok):
        return UnusableSensitivities(
            f"the sensitivities could not be checked ({plus.reason or minus.reason})"
        )
    expected, change = found.matrix @ (x_plus - x_minus), plus.residuals - minus.residuals
    tolerance = SENSITIVITY_AGREEMENT + 10.0 * (space.problem.model.solver.rtol or 0.0)
    whole = max(float(np.linalg.norm(change)), float(np.linalg.norm(expected)))
    for e, row in enumerate(plus.rows):
        size = max(float(np.linalg.norm(change[row])), 0.01 * whole)
        error = float(np.linalg.norm(change[row] - expected[row]))
        if error > tolerance * size:
            name = space.problem.experiments[space.experiments[e]].id
            return UnusableSensitivities(
                "the FMU's directional derivatives differ from finite differences by "
                f"{100.0 * error / size:.2g} % in experiment {name!r}"
            )
    return None


def _check_points(
    space: SearchSpace, x: FloatArray, found: ResidualJacobian
) -> tuple[FloatArray, FloatArray]:
    """Return two points between which all relevant unknowns change the residuals equally."""
    sizes = np.where(space.logarithmic, 1.0, np.maximum(np.abs(x), space.typical))
    effects = np.sqrt(np.add.reduce(found.matrix**2, axis=0)) * sizes
    effects = np.maximum(effects, LEAST_EFFECT * effects.max(initial=0.0))
    shares = effects.min(initial=np.inf) / effects if effects.all() else np.ones(space.size)
    relative = relative_noise(space.problem.model.solver) ** (1.0 / 3.0)
    signs = np.where(np.arange(space.size) % 2 == 0, 1.0, -1.0)
    steps = relative * sizes * shares * signs
    return np.clip(x + steps, space.lower, space.upper), np.clip(
        x - steps, space.lower, space.upper
    )


@dataclass(frozen=True)
class CostDerivatives:
    """First derivatives at a point.

    Attributes
    ----------
    gradient : (unknowns,)
        Gradient of the cost; zero for frozen unknowns.
    constraint_jacobian : (constraints, unknowns)
        Jacobian of `Evaluation.constraints`; zero in frozen columns, too.
    gauss_newton : (unknowns, unknowns) or None
        2 J'WJ, the Gauss-Newton matrix of the cost, if the cost has weights.
    frozen : (unknowns,)
        Unknowns whose derivatives could not be computed, because a simulation failed or a
        constraint is undefined at a neighbour.
    residual_jacobian
        Jacobian of the residuals, if the cost has weights.
    walls
        See `ResidualJacobian.walls`.
    """

    gradient: FloatArray
    constraint_jacobian: FloatArray
    gauss_newton: FloatArray | None
    frozen: npt.NDArray[np.bool_]
    residual_jacobian: ResidualJacobian | None = field(default=None, repr=False)
    walls: FloatArray = field(default_factory=lambda: np.zeros(0))


def derivatives(
    space: SearchSpace,
    x: FloatArray,
    at: Evaluation,
    scheme: Scheme,
    relative_step: float,
    progress: Progress | None,
    *,
    provider: JacobianProvider | None = None,
) -> Generator[Points, list[Evaluation], CostDerivatives]:
    """Compute the derivatives of cost and constraints at `x`.

    Parameters
    ----------
    space, x, at
        The space, the point and its evaluation, which must be `ok`.
    scheme
        "forward" costs one evaluation for each colour of unknowns, or for each unknown if the cost
        has no weights; "central" costs two.
    relative_step
        Relative step; 0 selects the step from the noise of the solver.
    progress
        Line of the iteration table.
    provider
        Source of Jacobians, in place of `scheme` and `relative_step`.
    """
    residuals = at.residuals
    weights = space.problem.cost.weights(residuals, space.outputs)
    if weights is None:
        return (yield from _cost_differences(space, x, at, scheme, relative_step, progress))
    if provider is not None:
        jacobians = yield from provider.jacobian(space, x, at, progress)
    else:
        jacobians = yield from jacobian(space, x, at, scheme, relative_step, progress)
    return _from_jacobian(jacobians, residuals, weights)


def _from_jacobian(
    jacobians: ResidualJacobian, residuals: FloatArray, weights: FloatArray
) -> CostDerivatives:
    """Return the derivatives of a cost with weights: 2 J'Wr and 2 J'WJ."""
    weighted = jacobians.matrix * weights[:, None]
    gradient = 2.0 * np.add.reduce(weighted * residuals[:, None], axis=0)
    gauss_newton = 2.0 * (jacobians.matrix.T @ weighted)
    return CostDerivatives(
        gradient,
        jacobians.constraint_jacobian,
        gauss_newton,
        jacobians.frozen,
        jacobians,
        jacobians.walls,
    )


def _cost_differences(
    space: SearchSpace,
    x: FloatArray,
    at: Evaluation,
    scheme: Scheme,
    relative_step: float,
    progress: Progress | None,
) -> Generator[Points, list[Evaluation], CostDerivatives]:
    """Compute differences of the cost itself, with one or two points for each unknown."""
    steps = difference_steps(space, x, scheme, relative_step)
    beside = Neighbours(x, scheme, [np.array([i], np.intp) for i in range(space.size)])
    purpose = "gradient" if scheme == "forward" else "gradient_central"
    here, wanted = _values(at), np.ones(space.size, dtype=bool)
    gradient = np.zeros(space.size)
    constraints = np.zeros((len(space.constraint_names), space.size))
    for parts in STEP_PARTS[scheme]:
        yield from beside.ask(space, steps, parts, wanted.copy(), purpose, progress)
        for i in np.flatnonzero(wanted).tolist():
            found = None if here is None else beside.derivative(i, here, _values)
            if found is not None and np.isfinite(found).all():
                wanted[i], gradient[i], constraints[:, i] = False, found[0], found[1:]
        if not wanted.any():
            break
    on_parameters = space.parameter_constraint_jacobian(x)
    constraints[: len(on_parameters)] = np.where(wanted, 0.0, on_parameters)
    return CostDerivatives(gradient, constraints, None, wanted, walls=beside.walls)


def _values(at: Evaluation) -> FloatArray | None:
    """Return the cost and then the constraints; None if one of them is undefined."""
    values = np.array([at.cost, *at.constraints])
    return values if np.isfinite(values).all() else None
