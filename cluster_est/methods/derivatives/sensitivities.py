"""Jacobians that the model carries along with a simulation, for as long as they can be trusted.

A worker gives the derivatives of the residuals by the physical values (see
`workers.simulation.sensitivities`); the chain rule gives those by the unknowns. The first of them
is checked against a central difference along one direction, in which each unknown that matters
moves the residuals equally much: an FMU's directional derivatives may be wrong. Differences take
their place where they are, or where the model has none.
"""

from __future__ import annotations

from collections.abc import Generator

import numpy as np

from cluster_est.methods.base import Evaluation, Points, Progress
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.derivatives.differences import (
    Differences,
    ResidualJacobian,
    Scheme,
    difference_steps,
    jacobian,
    relative_noise,
)
from cluster_est.problem.space import SearchSpace
from workers.messages import FloatArray

CHAIN_STEP = 6e-6
"""Relative, of the differences of physical values by the unknowns: formulas, of no noise."""
AGREEMENT = 1e-3
"""By how much, relative to their size, the residuals' changes may differ in the check."""
LEAST_EFFECT = 1e-3
"""An unknown that matters less than this part of the one that matters most is checked less."""

Asking = Generator[Points, list[Evaluation], ResidualJacobian]


class JacobianProvider:
    """How a search takes its Jacobians.

    Parameters
    ----------
    differences
        "sensitivities" for those that the model carries along, and as "auto" where it has none.

    Attributes
    ----------
    scheme
        Of the differences; None as long as sensitivities are taken.
    note
        Why they are not any more; "" if nothing is wrong.
    """

    def __init__(self, space: SearchSpace, differences: Differences, relative_step: float) -> None:
        self._space, self._relative_step = space, relative_step
        self._automatic = differences in ("auto", "sensitivities")
        self._checked = False
        self.scheme: Scheme | None = "central" if differences == "central" else "forward"
        if differences == "sensitivities":
            self.scheme = None
        self.note = ""

    @property
    def exact(self) -> bool:
        """Whether no better ones are to be had."""
        return self.scheme != "forward"

    def refine(self) -> bool:
        """Go over from forward to central differences, where that is left open; whether it was."""
        if not self._automatic or self.exact:
            return False
        self.scheme = "central"
        return True

    def jacobian(
        self, near: SearchSpace, x: FloatArray, at: Evaluation, progress: Progress | None
    ) -> Asking:
        """Ask for a Jacobian; `near` is the space, with the sizes for central differences."""
        if self.scheme is None:
            found = yield from carried(self._space, x, at, progress)
            if isinstance(found, ResidualJacobian):
                why = "" if self._checked else (yield from disagreement(self._space, x, found))
                self._checked = True
            else:
                why = found
            if isinstance(found, ResidualJacobian) and not why:
                return found
            self.note, self.scheme = (
                f"differences took the place of sensitivities: {why}",
                "forward",
            )
        space = near if self.scheme == "central" else self._space
        return (yield from jacobian(space, x, at, self.scheme, self._relative_step, progress))


def carried(
    space: SearchSpace, x: FloatArray, at: Evaluation, progress: Progress | None
) -> Generator[Points, list[Evaluation], ResidualJacobian | str]:
    """Ask for one point with sensitivities. Returns the Jacobian, or why there is none."""
    (found,) = yield Points(x[None, :], "sensitivities", progress, sensitivities=True)
    rows, places = at.rows, space.constraint_rows
    parts = [
        np.zeros((row.stop - row.start, len(c))) for row, c in zip(rows, space.acting, strict=True)
    ]
    constraints = np.zeros((len(space.constraint_names), space.size))
    own = space.parameter_constraint_slopes(x)
    constraints[: len(own)] = own
    given: list[FloatArray] = []
    for outcome in found.outcomes:
        if outcome.sensitivities is None:
            return outcome.message
        given.append(outcome.sensitivities)
    for e, chain in enumerate(_chain(space, x)):
        used = np.flatnonzero(chain.any(axis=1))
        slopes = given[e][:, used]
        if not np.isfinite(slopes).all():
            bad = used[np.flatnonzero(~np.isfinite(slopes).all(axis=0))[0]]
            name = space.problem.model.parameters[bad]
            return f"the model has no finite ones by {name!r}"
        columns = slopes @ chain[used]
        parts[e] = columns[: len(parts[e])]
        constraints[places[e], space.acting[e]] = columns[len(parts[e]) :]
    blocks = BlockMatrix(tuple(parts), space.acting, space.size)
    steps = difference_steps(space, x, "central", 0.0)
    return ResidualJacobian(blocks, np.zeros(space.size, bool), steps, constraints)


def _chain(space: SearchSpace, x: FloatArray) -> list[FloatArray]:
    """For each experiment (parameters, unknowns that act on it): d physical / d x."""
    steps = CHAIN_STEP * np.where(x == 0.0, 1.0, np.maximum(np.abs(x), 1e-3 * space.typical))
    parts = [np.zeros((len(space.problem.model.parameters), len(c))) for c in space.acting]
    colour_of = np.zeros(space.size, np.intp)
    tables = []
    for colour, members in enumerate(space.colours):
        colour_of[members] = colour
        ahead, behind = x.copy(), x.copy()
        ahead[members] = np.minimum(x[members] + steps[members], space.upper[members])
        behind[members] = np.maximum(x[members] - steps[members], space.lower[members])
        tables.append((space.physical(ahead) - space.physical(behind), ahead - behind))
    for e, columns in enumerate(space.acting):
        for j, i in enumerate(columns.tolist()):
            change, widths = tables[colour_of[i]]
            if widths[i] > 0.0:
                parts[e][:, j] = change[e] / widths[i]
    return parts


def disagreement(
    space: SearchSpace, x: FloatArray, found: ResidualJacobian
) -> Generator[Points, list[Evaluation], str]:
    """Compare a Jacobian with a difference along one direction. Returns what is wrong, or ""."""
    ahead, behind = _sides(space, x, found)
    high, low = yield Points(np.vstack([ahead, behind]), "sensitivities_check")
    if not (high.ok and low.ok):
        return f"they could not be checked ({high.reason or low.reason})"
    expected, change = found.matrix @ (ahead - behind), high.residuals - low.residuals
    tolerance = AGREEMENT + 10.0 * (space.problem.model.solver.rtol or 0.0)
    whole = max(float(np.linalg.norm(change)), float(np.linalg.norm(expected)))
    for e, row in enumerate(high.rows):
        size = max(float(np.linalg.norm(change[row])), 0.01 * whole)
        error = float(np.linalg.norm(change[row] - expected[row]))
        if error > tolerance * size:
            name = space.problem.experiments[space.experiments[e]].id
            return (
                f"the FMU's directional derivatives disagree with differences by "
                f"{100.0 * error / size:.2g} % in experiment {name!r}"
            )
    return ""


def _sides(
    space: SearchSpace, x: FloatArray, found: ResidualJacobian
) -> tuple[FloatArray, FloatArray]:
    """Two points between which every unknown that matters changes the residuals equally much."""
    logarithmic = np.array([unknown.log for unknown in space.unknowns], dtype=bool)
    sizes = np.where(logarithmic, 1.0, np.maximum(np.abs(x), space.typical))
    effects = np.sqrt(np.add.reduce(found.matrix**2, axis=0)) * sizes
    effects = np.maximum(effects, LEAST_EFFECT * effects.max(initial=0.0))
    shares = effects.min(initial=np.inf) / effects if effects.all() else np.ones(space.size)
    relative = relative_noise(space.problem.model.solver) ** (1.0 / 3.0)
    signs = np.where(np.arange(space.size) % 2 == 0, 1.0, -1.0)
    steps = relative * sizes * shares * signs
    return np.clip(x + steps, space.lower, space.upper), np.clip(
        x - steps, space.lower, space.upper
    )
