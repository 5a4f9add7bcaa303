"""Checks of the solver: accuracy, stiffness and directional derivatives.

The time of a simulation with sensitivities is compared with that of finite differences. Only the
config selects sensitivities, because a result must not depend on the speed of a machine.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from cluster_est.preflight.subject import (
    CheckFinding,
    CheckSubject,
    CheckVerdict,
    not_done,
    note,
    passed,
    unanswered,
)
from cluster_est.results.solver_error.finer_solver import LEAST_RTOL, RTOL_TIGHTENING
from cluster_est.toml import dotted
from workers.messages import FloatArray, Solver
from workers.probes.probes import (
    DirectionalProbe,
    SensitivityCostProbe,
    SolverProbe,
    StiffnessProbe,
)
from workers.process.trial import NoAnswer
from workers.simulation.integrator import DEFAULT_RTOL
from workers.simulation.jacobian import MAX_JACOBIAN_ERROR

CHEAPER = 0.5
"""Sensitivities are recommended below this fraction of the time of differences. It is far from 1,
because times vary, and because the differences of a Jacobian run on all workers at once."""
SIMULATIONS_OF_TRIAL = 10
"""Approximate time of the trial, in simulations without sensitivities."""


def sensitivities(subject: CheckSubject) -> list[CheckFinding]:
    """Compare the times of sensitivities and differences, if the FMU and the config offer both."""
    model = subject.problem.model
    unknowns = len(subject.space.acting[subject.experiment])
    offered = subject.description.offer(model.interface).provides_directional_derivatives
    choice = offered and model.interface == "model_exchange" and not subject.problem.effects
    choice = choice and subject.repeats and subject.reset_policy == "reset"
    if not choice or unknowns == 0:
        return []
    found = subject.ask(
        SensitivityCostProbe(subject.experiment, subject.start), SIMULATIONS_OF_TRIAL
    )
    if isinstance(found, NoAnswer):
        return [unanswered("sensitivities", found)]
    if found is None:
        return []
    part = found.carrying / (found.plain * unknowns)
    said = (
        "one simulation that also computes the derivatives with respect to all parameters takes "
        f"{part:.2g} of the time of the {unknowns} simulations that forward differences need"
    )
    if part > CHEAPER:
        return [passed("sensitivities", said)]
    do = 'for least_squares and sqp, set method.options.differences = "sensitivities"'
    return [passed("sensitivities", said, do)]


COUNTING = 0.3
"""Relative change above which an output may count steps, regardless of its declaration."""
GOOD_RELATIVE_CHANGE, BAD_RELATIVE_CHANGE = 1e-5, 1e-2
"""Relative changes of the outputs below which all is well, and above which there is a problem."""

NOISE_GOOD, NOISE_BAD = 0.1, 1.0
"""Changes of the outputs, relative to the declared standard deviation of the noise, below which all
is well, and above which there is a problem."""


def accuracy(subject: CheckSubject) -> list[CheckFinding]:
    """Compare with a simulation with a tighter tolerance or a shorter step."""
    if not subject.repeats:
        return []
    if (
        subject.problem.model.interface == "co_simulation"
        and not subject.description.variable_steps
    ):
        said = "the communication step is fixed, so it cannot be halved for a comparison"
        return [not_done("accuracy", said)]
    solver = subject.problem.model.solver
    other, how, key = _finer(subject, solver)
    found = subject.ask(SolverProbe(*subject.probe_arguments, other), 6)
    if isinstance(found, NoAnswer):
        return [unanswered("accuracy", found)]
    return _judged(subject, found, how, key)


def _judged(subject: CheckSubject, found: FloatArray, how: str, key: str) -> list[CheckFinding]:
    """Judge by the outputs that change between events; others may count steps."""
    names = subject.problem.experiments[subject.experiment].recorded
    pairs = list(zip(names, found.tolist(), strict=True))
    moving = [pair for pair in pairs if subject.description.variables[pair[0]].is_continuous]
    others = [pair for pair in pairs if pair not in moving]
    lines = []
    if moving:
        name, far = max(moving, key=_far)
        said = f"with {how}, {name} changes most, by {far:.2g} of its size"
        share, noisy = _against_noise(subject, moving)
        said += noisy
        bad = far > BAD_RELATIVE_CHANGE or share > NOISE_BAD
        verdict = CheckVerdict.PROBLEM if bad else CheckVerdict.NOTE
        fine = passed("accuracy", said)
        do = f"set {key}"
        if far >= COUNTING:
            do += "; if the output counts steps or calls, do nothing"
        good = far < GOOD_RELATIVE_CHANGE and share < NOISE_GOOD
        lines.append(fine if good else CheckFinding(verdict, "accuracy", said, do))
    name, far = max(others, key=_far, default=("", 0.0))
    if not far < GOOD_RELATIVE_CHANGE:
        said = (
            f"with {how}, {name}, which is not a continuous output, changes by {far:.2g} of its "
            "size"
        )
        do = f"if the output counts steps or calls, do nothing; otherwise, set {key}"
        lines.append(note("accuracy", said, do))
    return lines or [passed("accuracy", f"with {how}, no output changes")]


def _against_noise(subject: CheckSubject, errors: list[tuple[str, float]]) -> tuple[float, str]:
    """Return the largest error of an output over its declared noise, and a text about it."""
    experiment = subject.problem.experiments[subject.experiment]
    given = [o for o in experiment.outputs if o.has_sigma and not o.ordinal]
    sigmas = {o.variable: o.sigma for o in given}
    if subject.trajectory is None:
        return 0.0, ""
    sizes = dict(
        zip(experiment.recorded, np.abs(subject.trajectory).max(axis=0).tolist(), strict=True)
    )
    shares = [
        (far * (sizes[name] or 1.0) / sigmas[name], name) for name, far in errors if name in sigmas
    ]
    share, name = max(shares, default=(0.0, ""))
    if not share > 0.0:
        return 0.0, ""
    small = "" if share < NOISE_GOOD else ", which is not small compared with the noise"
    return share, f"; that is {share:.2g} of {dotted('sigma', name)}{small}"


def _far(pair: tuple[str, float]) -> float:
    return math.inf if math.isnan(pair[1]) else pair[1]


def _finer(subject: CheckSubject, solver: Solver) -> tuple[Solver, str, str]:
    if solver.name in ("rk4", "fmu"):
        step = min(solver.step or math.inf, longest_step(subject))
        name = "the step" if solver.name == "rk4" else "the communication step"
        how = f"{name} of {step:.3g} s halved"
        return replace(solver, step=step / 2.0), how, f"model.step = {step / 4.0:.3g}"
    rtol = DEFAULT_RTOL if solver.rtol is None else solver.rtol
    tight = max(rtol / RTOL_TIGHTENING, LEAST_RTOL)
    atol = None if solver.atol is None else solver.atol * tight / rtol
    how = f"model.rtol = {tight:.1g} instead of {rtol:.1g}"
    return replace(solver, rtol=tight, atol=atol), how, f"model.rtol = {tight:.1g}"


def longest_step(subject: CheckSubject) -> float:
    """Return the longest step from one time in the data to the next."""
    experiment = subject.problem.experiments[subject.experiment]
    times = [np.array([experiment.start, experiment.stop])]
    times += [output.times for output in experiment.outputs]
    times += [given.times for given in experiment.inputs]
    every = np.unique(np.concatenate(times))
    within = every[(every >= experiment.start) & (every <= experiment.stop)]
    return float(np.diff(within).max())


def stiffness(subject: CheckSubject) -> list[CheckFinding]:
    """Check whether an explicit solver suits a model in model exchange."""
    model = subject.problem.model
    if model.interface != "model_exchange" or model.solver.name == "cvode":
        return []
    found = subject.ask(StiffnessProbe(subject.experiment, subject.start), 1)
    if isinstance(found, NoAnswer):
        return [unanswered("stiffness", found)]
    if found:
        said = f"the model is stiff: the stability limit shortens the steps of {model.solver.name}"
        return [note("stiffness", said, 'set model.solver = "cvode"')]
    return [passed("stiffness", f"not stiff; {model.solver.name} is suitable")]


def derivatives(subject: CheckSubject) -> list[CheckFinding]:
    """Compare directional derivatives with finite differences, in model exchange."""
    model = subject.problem.model
    exchange = model.interface == "model_exchange"
    offered = subject.description.offer(model.interface).provides_directional_derivatives
    if not offered or not exchange or not subject.description.states:
        return []
    check = "derivatives"
    found = subject.ask(DirectionalProbe(subject.experiment, subject.start), 1)
    if isinstance(found, NoAnswer):
        return [unanswered(check, found)]
    do = (
        "do not use directional derivatives in a fit; export the FMU again without them, or report "
        "this to the exporter"
    )
    if found.zero:
        said = "directional derivatives are declared, but all of them are 0"
        return [note(check, said, do)]
    if not found.error <= MAX_JACOBIAN_ERROR:  # NaN counts as a difference
        said = f"directional derivatives differ from finite differences by {found.error:.2g}"
        return [note(check, f"{said} of the largest derivative", do)]
    said = f"directional derivatives agree with finite differences within {found.error:.1g}"
    return [passed(check, said), *sensitivities(subject)]
