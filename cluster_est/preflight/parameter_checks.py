"""Checks of parameters: their influence, and the ranges that the FMU declares."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from cluster_est.methods.differences import relative_noise
from cluster_est.preflight.subject import (
    CheckFinding,
    CheckSubject,
    fault,
    listed,
    not_done,
    note,
    passed,
    unanswered,
)
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.unknowns import Unknown
from cluster_est.problem.variables import silent_inputs, stays
from cluster_est.toml import dotted
from workers.messages import FloatArray
from workers.probes.probes import MovementProbe
from workers.process.trial import NoAnswer

CHANGE = 0.01
"""Change of an unknown, in noticeable changes."""
UNKNOWN_EFFECT = 1e-300
"""Placeholder for an influence that was not computed in every experiment."""
ROUNDING_OF_OUTPUTS = 1e-9
"""Relative influence on the outputs below which rounding dominates."""
TRIED_DIFFERENCE_STEPS = tuple(10.0**-k for k in range(3, 9))
"""Relative steps of finite differences to try."""
DERIVATIVE_AGREEMENT = 0.02
"""Largest relative difference of derivatives that count as equal."""


def effects(subject: CheckSubject) -> list[CheckFinding]:
    """Change each parameter slightly, one at a time, and return findings on its influence."""
    unknowns = _unknowns(subject)
    if not unknowns:
        return []
    if not subject.repeats:
        said = "not tested, because simulations differ even with the same parameters"
        return [not_done("parameters", said)]
    points = np.array([_moved(subject, column, CHANGE) for column, _ in unknowns])
    probe = MovementProbe(*subject.probe_arguments, points, max(subject.budget.left / 2.0, 0.1))
    found = subject.ask(probe, 2, subject.budget.left)
    if isinstance(found, NoAnswer):
        return [unanswered("parameters", found)]
    names = [unknown.label for _, unknown in unknowns]
    pairs = list(zip(names, found, strict=False))
    sizes = {name: each for name, each in pairs if not isinstance(each, str)}
    for (column, unknown), (name, each) in zip(unknowns, pairs, strict=False):
        if each == 0.0:
            sizes[name] = _effect_elsewhere(subject, column, unknown)
    lines = [_failed(name, each) for name, each in pairs if isinstance(each, str)]
    dead = [name for name, size in sizes.items() if size == 0.0]
    waiting = _waiting(dead, subject) if len(dead) > 1 or len(dead) == len(sizes) else []
    lines += waiting or _dead(dead, subject)
    lines += [
        _faint(name, size) for name, size in sizes.items() if 0.0 < size < ROUNDING_OF_OUTPUTS
    ]
    alive = {name: size for name, size in sizes.items() if size >= ROUNDING_OF_OUTPUTS}
    if alive:
        least, most = min(alive, key=alive.__getitem__), max(alive, key=alive.__getitem__)
        said = f"{len(alive)} of {len(names)} parameters affect the outputs: a change of {most} by "
        said += f"1 % of its size changes them by {alive[most]:.2g} of their size"
        said += f", and of {least} by {alive[least]:.2g}" if least != most else ""
        lines.append(passed("parameters", said))
        lines += _steps(subject, unknowns[names.index(most)][0])
    if len(found) < len(names):
        left = f"{len(names) - len(found)} of {len(names)} were not tested"
        lines.append(unanswered("parameters", NoAnswer(left, late=True)))
    return lines


def _unknowns(subject: CheckSubject) -> list[tuple[int, Unknown]]:
    """Return the first unknown of each of the model's parameters that acts on the experiment."""
    first: dict[str, tuple[int, Unknown]] = {}
    count = len(subject.problem.model.parameters)
    for column, unknown in enumerate(subject.space.unknowns):
        if subject.experiment in unknown.experiments and unknown.column < count:
            first.setdefault(unknown.parameter.name, (column, unknown))
    return list(first.values())


def _effect_elsewhere(subject: CheckSubject, column: int, unknown: Unknown) -> float:
    """Return the first influence in other experiments; `UNKNOWN_EFFECT` if time is too short."""
    for e in unknown.experiments:
        other = replace(subject, experiment=e)
        if e == subject.experiment:
            continue
        probe = MovementProbe(
            *other.probe_arguments, _moved(other, column, CHANGE)[None], subject.budget.left
        )
        found = subject.ask(probe, 2)
        if isinstance(found, NoAnswer) or not found or isinstance(found[0], str):
            return UNKNOWN_EFFECT
        if found[0] > 0.0:
            return float(found[0])
    return 0.0


def _moved(subject: CheckSubject, column: int, share: float) -> FloatArray:
    """Return values with one unknown changed by a share of its size, within its bounds."""
    space = subject.space
    x = space.start.copy()
    step = share * float(space.typical[column])
    inside = x[column] + step <= space.upper[column]
    x[column] += step if inside else -step
    return subject.at(x)


def _dead(names: list[str], subject: CheckSubject) -> list[CheckFinding]:
    said = "has no effect: the outputs do not depend on it at the start values"
    if subject.declared:
        do = "fixed = true, or remove it, or measure an output that it affects"
        return [
            fault(f"parameter {name}", said, f"{dotted('parameters', name)}.{do}") for name in names
        ]
    if not names:
        return []
    given = {each.variable for each in subject.problem.experiments[subject.experiment].inputs}
    open_ = [v.name for v in subject.description.inputs() if v.name not in given]
    do = "they may have an effect if the inputs have data, as in a config"
    if not open_:
        do = (
            "try another experiment, because the FMU's default experiment does not show their "
            "effect"
        )
    said = f"the outputs do not depend on {listed(names)} at the start values"
    said += f", while the inputs {listed(open_)} have no data" if open_ else ""
    return [note("dead parameters", said, do)]


def _waiting(names: list[str], subject: CheckSubject) -> list[CheckFinding]:
    """Return a finding on parameters without influence if nothing drives the model."""
    if not subject.declared or not names:
        return []
    silent = silent_inputs(subject.problem, subject.description)
    if not silent:
        return []
    value = stays(subject.description.variables[silent[0]])
    while_ = f"while input {silent[0]} has no data and stays at {value}"
    if len(silent) > 1:
        while_ = f"while inputs {listed(silent)} have no data"
    said = f"the outputs do not depend on {listed(names)} {while_}"
    do = f'give {dotted("inputs", silent[0])} = "COLUMN" in the experiments, then check again'
    return [fault("parameters", said, do)]


def _faint(name: str, size: float) -> CheckFinding:
    if size == UNKNOWN_EFFECT:
        said = "has no effect in one experiment, and there was no time to try the other experiments"
        return not_done(f"parameter {name}", said, "give it more time with --seconds")
    said = (
        "has hardly any effect: if it changes by 1 % of its size, the outputs change by "
        f"{size:.2g} of their size"
    )
    return note(
        f"parameter {name}",
        said,
        f"try another {dotted('parameters', name)}.start, or fix the parameter",
    )


def _failed(name: str, said: str) -> CheckFinding:
    do = f"try another {dotted('parameters', name)}.start or narrower bounds"
    return note(f"parameter {name}", f"after a change by 1 % of its size, {said}", do)


def _steps(subject: CheckSubject, column: int) -> list[CheckFinding]:
    """Return a finding on the smallest relative step of reliable differences."""
    points = np.array([_moved(subject, column, step) for step in TRIED_DIFFERENCE_STEPS])
    probe = MovementProbe(*subject.probe_arguments, points, max(subject.budget.left / 3.0, 0.1))
    found = subject.ask(probe, 1 + len(TRIED_DIFFERENCE_STEPS))
    if isinstance(found, NoAnswer):
        return [unanswered("differences", found)]
    pairs = zip(TRIED_DIFFERENCE_STEPS, found, strict=False)
    quotients = [each / step for step, each in pairs if not isinstance(each, str)]
    if len(quotients) < len(TRIED_DIFFERENCE_STEPS):
        return [unanswered("differences", NoAnswer("simulations failed or took too long"))]
    truth = quotients[1]
    pairs = zip(TRIED_DIFFERENCE_STEPS, quotients, strict=True)
    good = [step for step, each in pairs if abs(each - truth) <= DERIVATIVE_AGREEMENT * truth]
    least = min(good, default=TRIED_DIFFERENCE_STEPS[0])
    usual = math.sqrt(relative_noise(subject.problem.model.solver))
    if least <= max(usual, TRIED_DIFFERENCE_STEPS[-1]):
        said = (
            "derivatives by finite differences are reliable down to relative steps of "
            f"{least:.0e}; a fit uses {usual:.0e}"
        )
        return [passed("differences", said)]
    said = (
        f"derivatives with respect to {subject.space.unknowns[column].label} are reliable only "
        "down to relative steps of "
    )
    do = f"set method.options.relative_step = {10.0 * least:.0e}, or a smaller model.rtol"
    return [note("differences", f"{said}{least:.0e}", do)]


def bounds(subject: CheckSubject) -> list[CheckFinding]:
    """Compare start values and bounds with the FMU's minima, maxima and units."""
    lines = []
    for parameter in subject.problem.parameters:
        if not parameter.auxiliary and parameter.target in subject.description.variables:
            lines += _outside(subject, parameter)
    return lines


def _outside(subject: CheckSubject, parameter: Parameter) -> list[CheckFinding]:
    variable = subject.description.variables[parameter.target]
    low = -math.inf if variable.low is None else variable.low
    high = math.inf if variable.high is None else variable.high
    where, allowed = f"parameter {parameter.name}", f"the FMU declares [{low:g}, {high:g}]"
    key = dotted("parameters", parameter.name)
    lines = []
    if not parameter.expression and not low <= parameter.start <= high:
        said = f"starts at {parameter.start:g}, but {allowed}"
        lines.append(fault(where, said, f"choose another {key}.start"))
    if not parameter.fixed and (
        (math.isfinite(parameter.lower) and parameter.lower < low)
        or (math.isfinite(parameter.upper) and parameter.upper > high)
    ):
        said = f"has bounds [{parameter.lower:g}, {parameter.upper:g}], but {allowed}"
        lines.append(note(where, said, f"choose {key}.bounds within that range"))
    if parameter.unit and variable.unit and parameter.unit != variable.unit:
        said = f"is given in {parameter.unit}, but the FMU uses {variable.unit}"
        do = f"check {key}.start and {key}.bounds, which are in the FMU's unit"
        lines.append(note(where, said, do))
    return lines


def corners(subject: CheckSubject) -> list[CheckFinding]:
    """Simulate with all parameters at their lower, then at their upper bounds, if finite."""
    space = subject.space
    named = []
    for name, bound in (("lower", space.lower), ("upper", space.upper)):
        if np.isfinite(bound).any():
            named.append((name, subject.at(np.where(np.isfinite(bound), bound, space.start))))
    if not named:
        return []
    points = np.array([point for _, point in named])
    probe = MovementProbe(*subject.probe_arguments, points, max(subject.budget.left / 3.0, 0.1))
    found = subject.ask(probe, 1 + len(named))
    if isinstance(found, NoAnswer):
        return [unanswered("bounds", found)]
    lines = [
        note(
            "bounds",
            f"with all parameters at their {name} bounds, {each}",
            "narrow the bounds; a search steps back from such points, but each of them costs time",
        )
        for (name, _), each in zip(named, found, strict=False)
        if isinstance(each, str)
    ]
    tried = [name for name, _ in named[: len(found)]]
    if tried and not lines:
        said = f"the FMU can be simulated with all parameters at their {' and '.join(tried)} bounds"
        lines.append(passed("bounds", said))
    left = [name for name, _ in named[len(found) :]]
    if left:
        said = f"not simulated with all parameters at their {' and '.join(left)} bounds"
        lines.append(unanswered("bounds", NoAnswer(said, late=True)))
    return lines
