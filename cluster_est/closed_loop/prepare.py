"""Everything that stands ready before the loop begins: workers, rehearsals, weights, notes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.selection.declared_model import BRIEF
from cluster_est.closed_loop.selection.synthetic_experiments import enlarged, shortened
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.statistics.noise import estimate_noise
from cluster_est.closed_loop.statistics.records import make_records
from cluster_est.closed_loop.workbench import (
    ENLARGED,
    HORIZONS,
    FitStart,
    LoopWorkbench,
    SimulationMeter,
)
from cluster_est.costs.sum_squared import SumSquared
from cluster_est.errors import ProblemError
from cluster_est.fit import check_method
from cluster_est.problem.problem import Problem
from cluster_est.problem.space import make_space
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.resources import one_blas_thread
from cluster_est.running.runner import Record, TaskOrigin
from workers.effects.forms import FORMS
from workers.effects.site import EffectSite, open_pairs, open_sites, parse_site
from workers.fmu.description import ModelDescription, nearest
from workers.messages import Experiment, Outcome

LEAST_SAMPLES_PER_UNKNOWN = 4


@contextmanager
def open_bench(
    problem: Problem, environment: RunEnvironment, settings: LoopSettings, seed: int
) -> Iterator[LoopWorkbench]:
    """Start the workers and install the experiments with their rehearsals.

    Where several outputs have no sigma, a first fit gives each its own from its noise, or one
    output's unit would decide what is found.
    """
    description = problem.describe()
    _check(problem, settings, description)
    weights: tuple[str, ...] = ()
    if _unweighted(problem):
        with _opened(problem, environment, settings, seed, description) as bench:
            (fitted,) = bench.fit("weights", [FitStart(problem, {})], BRIEF)
            if fitted is not None:
                noise = estimate_noise(fitted.residuals, bench.records)
                problem = _weighted(problem, dict(zip(bench.records.outputs, noise, strict=True)))
                weights = (_weight_note(problem),)
    with _opened(problem, environment, settings, seed, description) as bench:
        yield replace(bench, notes=(*bench.notes, *weights))


@contextmanager
def _opened(
    problem: Problem,
    environment: RunEnvironment,
    settings: LoopSettings,
    seed: int,
    description: ModelDescription,
) -> Iterator[LoopWorkbench]:
    train = problem.indices("train")
    runs = [problem.experiments[e] for e in train]
    installed = list(problem.experiments)
    rehearsals: dict[str, tuple[int, ...]] = {}
    for horizon in HORIZONS:
        rehearsals[f"{horizon:.0%}"] = _install(installed, [shortened(r, horizon) for r in runs])
    rehearsals["enlarged"] = _install(installed, [enlarged(r, ENLARGED) for r in runs])
    everything = replace(problem, experiments=tuple(installed))
    record = _named(everything.experiments, environment.monitor.record)
    meter = SimulationMeter(everything.experiments, record)
    with one_blas_thread(), environment.executor(everything) as executor:
        yield LoopWorkbench(
            runner=environment.runner(executor, record=meter, whole=True),
            problem=problem,
            description=description,
            settings=settings,
            seed=seed,
            train=train,
            records=make_records(runs),
            rehearsals=rehearsals,
            everything=everything,
            meter=meter,
            sites=_sites(problem, description),
            notes=_notes(problem),
        )


def _named(experiments: Sequence[Experiment], record: Record | None) -> Record | None:
    """A record that also hears which experiment it was: a rehearsal is none of the problem's."""
    if record is None:
        return None
    names = [(e.id, e.key) for e in experiments]

    def named(origin: TaskOrigin, outcome: Outcome) -> None:
        record(replace(origin, installed=names[origin.experiment]), outcome)

    return named


def _install(installed: list[Experiment], copies: list[Experiment]) -> tuple[int, ...]:
    first = len(installed)
    installed += copies
    return tuple(range(first, len(installed)))


def _check(problem: Problem, settings: LoopSettings, description: ModelDescription) -> None:
    """Refuse what the loop cannot work with.

    Raises
    ------
    ProblemError
        With what to change.
    """
    if not problem.plain or not isinstance(problem.cost, SumSquared):
        raise ProblemError(
            "closed loop: must have the cost sse, outputs measured over time and no constraints, "
            "because its tests are made for those, but has something else; remove it, and fit "
            "with it before or after"
        )
    train = make_space(problem, problem.indices("train"))
    check_method(BRIEF, train)
    samples = train.rows[-1].stop
    if samples < LEAST_SAMPLES_PER_UNKNOWN * (train.size + 1):
        raise ProblemError(
            f"closed loop: the training experiments must have at least "
            f"{LEAST_SAMPLES_PER_UNKNOWN * (train.size + 1)} measured values to tell a missing "
            f"effect from {train.size} parameters but have {samples}; add data or fix parameters"
        )
    known = sorted({name for _, name in FORMS})
    for name in settings.forms:
        if name not in known:
            raise ProblemError(
                f"closed_loop.effects: there is no form {name!r}{nearest(name, known)}"
            )
    offered = _sites(problem, description)
    for site in settings.sites:
        if site not in offered:
            raise ProblemError(
                f"closed_loop.sites: {description.file} does not offer the site {site!r}"
                f"{nearest(site, offered)}"
            )
    kinds = {parse_site(site, "closed_loop.sites").kind for site in settings.sites or offered}
    if settings.forms and not any((kind, f) in FORMS for kind in kinds for f in settings.forms):
        raise ProblemError(
            f"closed_loop.effects: must name a form for one of the sites but {settings.forms} are "
            f"none at {' or '.join(sorted(kinds))} sites; change closed_loop.effects or sites"
        )


def _unweighted(problem: Problem) -> bool:
    """Whether there are several outputs, and nobody said how exact each is."""
    outputs = [o for e in problem.experiments for o in e.outputs]
    return len({o.variable for o in outputs}) > 1 and all(o.sigma == 1.0 for o in outputs)


def _weighted(problem: Problem, noise: dict[str, float]) -> Problem:
    experiments = []
    for experiment in problem.experiments:
        outputs = [
            replace(o, sigma=float(noise[o.variable]))
            if np.isfinite(noise.get(o.variable, np.nan)) and noise[o.variable] > 0.0
            else o
            for o in experiment.outputs
        ]
        experiments.append(replace(experiment, outputs=tuple(outputs)))
    return replace(problem, experiments=tuple(experiments))


def _weight_note(problem: Problem) -> str:
    sigmas = {o.variable: o.sigma for e in problem.experiments for o in e.outputs}
    pairs = ", ".join(f"{name} = {sigma:.6g}" for name, sigma in sigmas.items())
    return (
        "no sigma was given for several outputs, so each was weighted with its estimated noise; "
        f"write sigma = {{ {pairs} }} into the experiments for a fit with the same weights"
    )


def _sites(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    interface = problem.model.interface
    pairs = open_pairs(description, interface)
    pairs += [EffectSite("pair", *reversed(site.targets)) for site in pairs]
    return tuple(str(site) for site in [*open_sites(description, interface), *pairs])


def _notes(problem: Problem) -> tuple[str, ...]:
    notes = list(problem.notes())
    if not problem.indices("test"):
        notes.append(
            'no experiment has role = "test": nothing could veto what was found, and the errors '
            "are those of the data that it was found on"
        )
    if len(problem.indices("train")) == 1:
        notes.append(
            "there is only one training experiment: quarters of its record were predicted from the "
            "rest instead of experiments from each other"
        )
    if problem.model.interface == "co_simulation":
        notes.append(
            "co-simulation: state derivatives were closed; an effect inside the model can only be "
            "seen as one at an input, an output or a parameter"
        )
    return tuple(notes)
