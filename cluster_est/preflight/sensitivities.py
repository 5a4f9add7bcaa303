"""The cost of a simulation with sensitivities, against those that differences take.

A config has to choose them: what a clock finds on one machine must not decide what another
computes.
"""

from __future__ import annotations

from cluster_est.preflight.findings import CheckFinding, CheckVerdict
from cluster_est.preflight.subject import CheckSubject, unanswered
from workers.probes.sensitivities import SensitivityCostProbe
from workers.process.trial import NoAnswer

CHEAPER = 0.5
"""Part of the time of differences from which sensitivities are recommended. Far from 1, because
times vary, and because differences of a Jacobian run on all workers at once."""
SIMULATIONS = 10
"""As long as which the trial takes about, in simulations without sensitivities."""


def sensitivities(subject: CheckSubject) -> list[CheckFinding]:
    """The time of both; nothing where the FMU or the config leaves no choice."""
    model = subject.problem.model
    unknowns = len(subject.space.acting[subject.experiment])
    offered = subject.description.offer(model.interface).provides_directional_derivatives
    choice = offered and model.interface == "model_exchange" and not subject.problem.effects
    choice = choice and subject.repeats and subject.reset_policy == "reset"
    if not choice or unknowns == 0:
        return []
    found = subject.ask(SensitivityCostProbe(subject.experiment, subject.start), SIMULATIONS)
    if isinstance(found, NoAnswer):
        return [unanswered("sensitivities", found)]
    if found is None:
        return []
    part = found.carrying / (found.plain * unknowns)
    said = (
        f"one simulation with the derivatives with respect to all parameters takes {part:.2g} of "
        f"the time of the {unknowns} that forward differences take"
    )
    if part > CHEAPER:
        return [CheckFinding(CheckVerdict.OK, "sensitivities", said)]
    do = 'method.options.differences = "sensitivities", for least_squares and sqp'
    return [CheckFinding(CheckVerdict.OK, "sensitivities", said, do)]
