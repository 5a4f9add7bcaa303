"""Checks of the start: a model that begins at rest with nothing to move it, or elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.preflight.findings import CheckFinding, CheckVerdict, listed
from cluster_est.preflight.subject import CheckSubject
from cluster_est.problem.effects.sensors import sensor_outputs
from cluster_est.results.initial_errors import (
    estimates_start,
    free_start_advice,
    initial_errors,
    noise_of_samples,
)
from cluster_est.results.output_errors import Simulation
from workers.messages import Experiment, FloatArray

STILL = 1e-9
"""Share of its size by which an output may change and yet stand still."""
CLEAR = 5.0
"""Times the noise by which a measured output moves clearly."""


def at_rest(subject: CheckSubject, simulations: Sequence[Simulation]) -> list[CheckFinding]:
    """Name the experiments in which nothing moves at the start values though it was measured to.

    One whose initial state is estimated may well begin at rest: it is left out.
    """
    resting = []
    for simulation in simulations:
        experiment = subject.problem.experiments[simulation.experiment]
        moving = [o for o in experiment.outputs if _moves(o.values)]
        known = not estimates_start(subject.space, simulation.experiment, subject.description)
        if moving and known and _still(simulation):
            resting.append((experiment, moving[0]))
    if not resting or not subject.declared:
        return []
    experiment, output = resting[0]
    several = len(resting) > 1
    where = f"experiment{'s' if several else ''} {listed([e.id for e, _ in resting])}"
    far = float(np.ptp(output.values))
    unit = "" if output.ordinal else subject.description.variables[output.variable].unit
    said = (
        f"nothing moves in the simulation of {where}{_though(experiment)}: its start is an "
        f"equilibrium; the measured {output.variable} moves by {f'{far:.3g} {unit}'.strip()}"
    )
    return [
        CheckFinding(
            CheckVerdict.NOTE,
            "start",
            said,
            f"{free_start_advice(subject.problem)}; or give the input that moves it",
        )
    ]


def starts_elsewhere(
    subject: CheckSubject, simulations: Sequence[Simulation]
) -> list[CheckFinding]:
    """Name the output that is farthest from its measurement at the first sample."""
    if not subject.declared:
        return []
    unknown = sensor_outputs(subject.problem)
    errors = initial_errors(subject.problem, simulations, fitted=False)
    found = [each for each in errors if each.output not in unknown]
    if not found:
        return []
    said = f"{found[0].sentence}, at the start values"
    return [CheckFinding(CheckVerdict.NOTE, "start", said, free_start_advice(subject.problem))]


def _though(experiment: Experiment) -> str:
    driven = [i.variable for i in experiment.inputs if np.ptp(i.values) > 0.0]
    return f", though {listed(driven)} does" if len(driven) == 1 else ""


def _still(simulation: Simulation) -> bool:
    trajectory = simulation.outcome.trajectory
    if trajectory is None or not trajectory.values.size:
        return False
    sizes = np.abs(trajectory.values).max(axis=0)
    return bool(np.all(np.ptp(trajectory.values, axis=0) <= STILL * sizes))


def _moves(values: FloatArray) -> bool:
    """Return True for a signal that moves by more than its noise."""
    if len(values) < 4 or np.ptp(values) == 0.0:
        return False
    return bool(np.std(values) > CLEAR * noise_of_samples(values))
