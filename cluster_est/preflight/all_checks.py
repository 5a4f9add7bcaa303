"""All checks of a preflight, in their order, within a time limit."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.executors import executor_class
from cluster_est.executors.backlog import BATCH_SECONDS
from cluster_est.preflight.data_checks import data_findings
from cluster_est.preflight.parameter_checks import bounds, corners, effects
from cluster_est.preflight.repeatability import (
    Remedy,
    instances,
    later,
    refused_parameters,
    remedy,
    repeatable,
    stop_time,
    without_parameters,
)
from cluster_est.preflight.solver_checks import accuracy, derivatives, stiffness
from cluster_est.preflight.subject import (
    CheckFinding,
    CheckPage,
    CheckSubject,
    CheckVerdict,
    TimeBudget,
    fault,
    listed,
    not_done,
    note,
    passed,
    unanswered,
)
from cluster_est.preflight.unit_checks import misread_units
from cluster_est.problem.problem import Problem
from cluster_est.problem.sensors import sensor_outputs
from cluster_est.results.initial_errors import (
    estimates_start,
    free_start_advice,
    initial_errors,
    noise_of_samples,
    start_advice,
)
from cluster_est.results.output_errors import Simulation
from cluster_est.running.resources import Resources
from workers.core.failure import MESSAGES, TERMINATED
from workers.messages import Experiment, FloatArray, Model, Outcome, Status, Task
from workers.probes.probes import CostProbe, SimulationCost, SimulationProbe
from workers.process.forked import CAN_FORK
from workers.process.trial import NoAnswer, ProbeBench

STILL = 1e-9
"""An output that changes by less than this share of its size counts as constant."""
CLEAR_CHANGE_OVER_NOISE = 5.0
"""A measured output that changes by more than this multiple of its noise is not constant."""


def at_rest(subject: CheckSubject, simulations: Sequence[Simulation]) -> list[CheckFinding]:
    """Return findings for experiments whose outputs are constant although measured as changing.

    An experiment with an estimated initial state may start at rest, so it is omitted.
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
        f"nothing changes in the simulation of {where}{_though(experiment)}: the simulation starts "
        f"in an equilibrium; but the measured {output.variable} changes by "
        f"{f'{far:.3g} {unit}'.strip()}"
    )
    return [
        note(
            "start",
            said,
            f"{free_start_advice(subject.problem)}; or give the input that causes the change",
        )
    ]


def starts_elsewhere(
    subject: CheckSubject, simulations: Sequence[Simulation]
) -> list[CheckFinding]:
    """Return a finding for the output with the largest error at the first sample."""
    if not subject.declared:
        return []
    unknown = sensor_outputs(subject.problem)
    errors = initial_errors(subject.problem, simulations, fitted=False)
    found = [each for each in errors if each.output not in unknown]
    if not found:
        return []
    said = f"{found[0].sentence}, at the start values"
    return [note("start", said, start_advice(subject.problem, found[0]))]


def _though(experiment: Experiment) -> str:
    driven = [i.variable for i in experiment.inputs if np.ptp(i.values) > 0.0]
    return f", although {listed(driven)} changes" if len(driven) == 1 else ""


def _still(simulation: Simulation) -> bool:
    trajectory = simulation.outcome.trajectory
    if trajectory is None or not trajectory.values.size:
        return False
    sizes = np.abs(trajectory.values).max(axis=0)
    return bool(np.all(np.ptp(trajectory.values, axis=0) <= STILL * sizes))


def _moves(values: FloatArray) -> bool:
    """Return whether a signal changes by more than its noise."""
    if len(values) < 4 or np.ptp(values) == 0.0:
        return False
    return bool(np.std(values) > CLEAR_CHANGE_OVER_NOISE * noise_of_samples(values))


MOST_SECONDS = 1.0
"""Longest duration of the measurement, if it gives enough simulations."""
ENOUGH = 150
"""Number of simulations that is always enough, however much time remains."""
SHORT_SIMULATION_SECONDS = 2e-4
"""Seconds; shorter simulations are faster in this process than in another one."""
LONG = 1.0
"""Seconds; for longer simulations, a method that needs few of them is recommended."""
LEAST_COUNT = 100
"""Smallest number of simulations that reveals a memory leak."""
LEAK = 1024.0
"""Smallest increase of the memory per simulation that counts as a leak, in bytes."""


def costs(subject: CheckSubject) -> list[CheckFinding]:
    """Return the median time of a simulation, and its memory leak."""
    seconds = max(
        min(MOST_SECONDS, subject.budget.left / 3.0),
        min(ENOUGH * subject.simulation_seconds, 0.75 * subject.share * subject.budget.left),
    )
    probe = CostProbe(*subject.probe_arguments, seconds)
    found = subject.ask(probe, 10)
    if isinstance(found, NoAnswer):
        return (
            [_one_measured(subject), unanswered("memory", found)]
            if subject.simulation_seconds
            else []
        )
    return [
        _time(subject, found.seconds, found.count),
        *_few_simulations(found.seconds),
        _memory(subject, found),
    ]


def _few_simulations(seconds: float) -> list[CheckFinding]:
    """Recommend options that need few simulations if each simulation is slow."""
    if seconds < LONG:
        return []
    said = (
        "simulations are slow, and by default least_squares uses more of them than necessary to "
        "keep many workers busy: 189 instead of 99 in the embedded example"
    )
    do = (
        'for few workers, set method.options = { trials = 1, differences = "forward" }; for ten or '
        "more unknowns, set secant_updates = 20 too; for the methods de, pso and ga, set early_end "
        "= true"
    )
    return [passed("few simulations", said, do)]


def _one_measured(subject: CheckSubject) -> CheckFinding:
    return _time(subject, subject.simulation_seconds, 1)


def _time(subject: CheckSubject, seconds: float, count: int) -> CheckFinding:
    cores = os.cpu_count() or 1
    said = f"{_shown(seconds)} for each simulation (median of {count})"
    together = round(BATCH_SECONDS / max(seconds, 1e-6))
    if together > 1:
        said += f"; a worker gets up to {together} simulations at a time"
    if seconds < SHORT_SIMULATION_SECONDS:
        said += "; a simulation is too short to be sent to another process"
        do = "" if subject.in_process else 'executor.name = "local" is enough'
    elif cores > 1 and not CAN_FORK:
        do = f"set executor.workers = {cores}"
    elif subject.in_process and cores > 1:
        do = (
            f'set executor.name = "processes" and executor.workers = {cores}, or use "ray" for a '
            "cluster"
        )
    else:
        do = ""
    return passed("cost", said, do)


def _shown(seconds: float) -> str:
    if seconds >= 1.0:
        return f"{seconds:.3g} s"
    return f"{1e3 * seconds:.3g} ms" if seconds >= 1e-3 else f"{1e6 * seconds:.3g} us"


def _memory(subject: CheckSubject, found: SimulationCost) -> CheckFinding:
    if found.leak is None or (found.count < LEAST_COUNT and found.leak < 50.0 * LEAK):
        said = f"{found.count} simulations are too few to detect a memory leak"
        budget, needed = subject.budget, 2.0 * LEAST_COUNT * subject.simulation_seconds
        enough = float(f"{budget.seconds - budget.left + needed:.1g}")
        do = f"give it more time with --seconds {max(enough, 2.0 * budget.seconds):g}"
        return not_done("memory", said, do)
    if found.leak < LEAK:
        return passed("memory", f"no leak in {found.count} simulations")
    said = f"each simulation leaks {found.leak / 1024:.3g} kB"
    lasts = subject.growth / found.leak
    if subject.in_process:
        do = (
            'set executor.name = "processes": its processes are replaced when they have grown too '
            "large"
        )
        return note("memory", said, do)
    said += f"; the process is replaced after about {lasts:.3g} simulations (executor.growth)"
    return note("memory", said)


SECONDS = 4.0
"""Time in seconds for all checks, once a process exists for them."""
LEAST_MOVEMENT = 0.01
"""Smallest change of an output that is informative, as a share of its largest range."""
SHARE_OF_LEFTOVER = 1.0
"""Share of the remaining time for a check that is repeated because its time was too short."""
LOADING, FIRST_SIMULATION = 0.6, 0.6
"""Shares of the remaining time for loading the FMU, and for one simulation."""

CHECKS: tuple[Callable[[CheckSubject], list[CheckFinding]], ...] = (
    lambda subject: [stop_time(subject), instances(subject)],
    effects,
    stiffness,
    accuracy,
    costs,
    corners,
    derivatives,
)
"""All checks, in the order in which they run."""


def run_checks(
    problem: Problem,
    resources: Resources,
    seconds: float = SECONDS,
    *,
    declared: bool = True,
    open_bench: Callable[[Model, Sequence[Experiment]], ProbeBench] = ProbeBench.open,
) -> CheckPage:
    """Check for everything that prevents a fit of an FMU, or makes it slow or wrong.

    Every call of the FMU is in a separate process, which is ended when its time is over.

    Parameters
    ----------
    problem
        The problem to be fitted.
    resources
        Resources of the fit.
    seconds
        Time for all checks together. Loading the project takes one or two additional seconds. With
        0, the FMU is not called at all.
    declared
        True if a config declares the parameters to be estimated.
    open_bench
        Opens the bench on which the FMU is tested.
    """
    description = problem.describe()
    data = data_findings(problem, description) if declared else []
    if seconds == 0.0:
        description.check_platform(problem.model.interface)
        said = "everything was read, and nothing was simulated"
        return CheckPage((*data, not_done("simulates", said, _MORE)), ())
    # before the time starts: the import of Ray takes a second
    in_process = executor_class(resources.executor).in_process
    model = resources.limited(problem.model)
    with open_bench(model, problem.experiments) as bench:
        loaded = bench.ask(None, 1e4 if seconds == np.inf else max(seconds, 1.0) * LOADING)
        if isinstance(loaded, NoAnswer):
            return CheckPage((_not_loaded(loaded),), (), loads=False)
        subject = CheckSubject(
            problem,
            description,
            bench,
            TimeBudget.of(seconds),
            in_process,
            resources.workers,
            resources.limits.growth,
            instances=resources.instances,
            declared=declared,
        )
        simulations = _simulate(subject)
        cure = remedy(subject, simulations)
        if cure.refused:
            smaller = without_parameters(problem, cure.refused)
            left = max(subject.budget.left, 0.1)
            page = run_checks(smaller, resources, left, declared=False, open_bench=open_bench)
            return replace(page, findings=(*page.findings, refused_parameters(cure.refused)))
        findings = [
            passed("loads", "the FMU can be loaded and instantiated"),
            *bounds(subject),
            *data,
            *_simulation_findings(subject, simulations, cure),
            *(at_rest(subject, simulations) or starts_elsewhere(subject, simulations)),
            *_probe_findings(subject, simulations),
        ]
    return CheckPage(tuple(findings), tuple(simulations))


def _probe_findings(subject: CheckSubject, simulations: list[Simulation]) -> list[CheckFinding]:
    """Run all checks on one of the experiments that can be simulated."""
    successful = [s for s in simulations if s.outcome.ok]
    if not successful:
        late = any(s.outcome.status is Status.TIMEOUT for s in simulations)
        stiff = [] if late else stiffness(subject)
        return [*stiff, *misread_units(subject, simulations)]
    first = _most_telling(successful)
    seen = first.outcome.trajectory
    subject = replace(
        subject,
        simulation_seconds=first.outcome.seconds,
        experiment=first.experiment,
        trajectory=None if seen is None or subject.problem.effects else seen.values,
    )
    findings, policy, earlier = repeatable(subject)
    subject = replace(subject, reset_policy=policy or "reset", repeats=policy is not None)
    found = [check(subject) for check in CHECKS]
    for check, own in zip(CHECKS, found, strict=True):
        findings += _done_again(check, own, subject)
    findings += later(subject, earlier)
    return findings + misread_units(subject, simulations)


def _done_again(
    check: Callable[[CheckSubject], list[CheckFinding]],
    own: list[CheckFinding],
    subject: CheckSubject,
) -> list[CheckFinding]:
    """Repeat a check in the remaining time if its time was too short; return its findings."""
    if all(each.verdict is not CheckVerdict.NOT_DONE for each in own):
        return own
    return check(replace(subject, share=SHARE_OF_LEFTOVER))


def _most_telling(simulations: list[Simulation]) -> Simulation:
    """Return the simulation with the most changing outputs, and of these the shortest.

    Length is the number of samples and not the time, so that the choice is reproducible.
    """
    seen = [simulation.outcome.trajectory for simulation in simulations]
    ranges = [
        {} if one is None else dict(zip(one.variables, np.ptp(one.values, axis=0), strict=True))
        for one in seen
    ]
    names = {name for own in ranges for name in own}
    largest = {name: max(own.get(name, 0.0) for own in ranges) for name in names}
    moving = [sum(own[name] > LEAST_MOVEMENT * largest[name] for name in own) for own in ranges]
    samples = [0 if one is None else len(one.times) for one in seen]
    return simulations[min(range(len(seen)), key=lambda i: (-moving[i], samples[i]))]


def _not_loaded(stopped: NoAnswer) -> CheckFinding:
    do = "check that the FMU does not wait for a licence or a window" if stopped.late else ""
    return fault("loads", stopped.message, do)


def _simulate(subject: CheckSubject) -> list[Simulation]:
    """Simulate each experiment once at the start values, as long as there is time."""
    problem, space = subject.problem, subject.space
    values = space.physical(space.start)
    found: list[Simulation] = []
    for e in range(len(problem.experiments)):
        limit = FIRST_SIMULATION * subject.budget.left
        if limit < 0.1 * subject.budget.seconds and found:
            outcome = Outcome(e, Status.NOT_RUN, message="no time was left for this experiment")
            found.append(Simulation(e, outcome))
            continue
        task = Task(e, e, values[e], "trajectory", problem.effects)
        answer = subject.bench.ask(SimulationProbe(task), limit)
        if isinstance(answer, NoAnswer):
            status = Status.TIMEOUT if answer.late else Status.CRASH
            answer = Outcome(e, status, message=answer.message, seconds=np.nan)
        found.append(Simulation(e, answer))
    return found


def _simulation_findings(
    subject: CheckSubject, simulations: list[Simulation], cure: Remedy
) -> list[CheckFinding]:
    """Return a finding for the experiments that can be simulated, and one for each other."""
    successful = [s for s in simulations if s.outcome.ok]
    lines = []
    for simulation in simulations:
        outcome = simulation.outcome
        name = f"experiment {subject.problem.experiments[simulation.experiment].id}"
        if outcome.status is Status.NOT_RUN:
            lines.append(not_done(name, outcome.message, _MORE))
        elif outcome.status is Status.TIMEOUT:
            said = f"at the start values, {outcome.message}"
            lines.append(fault(name, said, f"if the simulation is only slow, {_MORE}"))
        elif not outcome.ok:
            said = f"at the start values, {outcome.status}: {outcome.message}"
            do = _advice(outcome)
            if cure.step is not None and simulation is simulations[0]:
                do = f"set model.step = {cure.step:.3g}; with this step the simulation succeeds"
            lines.append(fault(name, said, do))
    if successful:
        said = (
            f"{len(successful)} of {len(simulations)} experiments can be simulated at the start "
            "values"
        )
        lines.append(passed("simulates", said))
    return lines


def _advice(outcome: Outcome) -> str:
    """Return advice for a failed simulation, depending on its failure."""
    if outcome.message.startswith(MESSAGES[TERMINATED]):
        return "write a config with an experiment that stops before that time"
    if 'model.solver = "cvode"' in outcome.message:
        return 'set model.solver = "cvode" in a config, or try other start values'
    return _ADVICE.get(outcome.status, "read the messages of the FMU, or try other start values")


_MORE = "give it more time with --seconds"
_ADVICE = {
    Status.CRASH: "simulate the FMU in another tool; if it crashes there too, ask the exporter of "
    "the FMU, and look for files, libraries or a licence that the FMU needs",
    Status.OUT_OF_MEMORY: "raise executor.memory",
}
