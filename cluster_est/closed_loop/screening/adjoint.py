"""Adjoint of the linear systems: what a forcing anywhere weighs with in sums of the residuals.

A direction is a linear map D from what is added at a site, f, to the residuals. For a weighting w
of the residuals, w'(D f) = (D'w)'f: one integration backwards gives D'w at every site at once,
where the directions themselves take one forwards for each candidate.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.screening.directions import coupling
from cluster_est.closed_loop.screening.linear_system import linear_system
from workers.effects.site import EffectSite
from workers.messages import FloatArray, Linearisation


@dataclass(frozen=True)
class AdjointSignals:
    """Along one experiment, what is added at any site weighs with these in m weighted sums.

    Attributes
    ----------
    linear
        The linear system.
    names
        Of the outputs.
    at_states : (n, x, m)
        At state derivatives.
    at_outputs : (n, y, m)
        At outputs.
    """

    linear: Linearisation = field(repr=False)
    names: tuple[str, ...]
    at_states: FloatArray = field(repr=False)
    at_outputs: FloatArray = field(repr=False)

    def at(self, site: EffectSite, state: str = "") -> FloatArray:
        """(n, m): at a site, at a pair at the derivative of one of its states."""
        linear = self.linear
        if site.kind in ("derivative", "pair"):
            return self.at_states[:, linear.state_names.index(state or site.target)]
        if site.kind == "output":
            if site.target not in self.names:  # not measured in this experiment
                return np.zeros((len(linear.times), self.at_outputs.shape[2]))
            return self.at_outputs[:, self.names.index(site.target)]
        into, through = coupling(linear, site)
        weighed = np.einsum("nx,nxm->nm", into, self.at_states)
        return np.asarray(weighed + np.einsum("ny,nym->nm", through, self.at_outputs))


def adjoint_signals(trajectory: LinearisedTrajectory, weights: FloatArray) -> AdjointSignals:
    """Integrate the adjoint along one experiment.

    Parameters
    ----------
    trajectory
        In model exchange.
    weights : (k, m)
        m weightings of the experiment's residuals.

    Raises
    ------
    ValueError
        Without a linearisation, as in co-simulation.
    """
    linear = trajectory.linear
    if linear is None:
        raise ValueError("the adjoint needs a linearisation")
    n, outputs = trajectory.outputs.shape
    at_outputs = np.zeros((n, outputs, weights.shape[1]))
    places = (trajectory.rows, trajectory.columns)
    np.add.at(at_outputs, places, -weights / trajectory.sigmas[:, None])
    at_states = np.matmul(linear.C.transpose(0, 2, 1), at_outputs)
    weighed = linear_system(linear).weigh(at_states)
    return AdjointSignals(linear, trajectory.names, weighed, at_outputs)
