"""The workbench of a closed loop: opened on workers, and checked; what is known before a search."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.closed_loop.fitter import (
    ENLARGED,
    SHORTENED,
    FitStart,
    FittedModel,
    Fitter,
    SimulationMeter,
    SyntheticKind,
    with_outputs,
)
from cluster_est.closed_loop.output_noise import is_told, noise_of
from cluster_est.closed_loop.selection.starts import BRIEF
from cluster_est.closed_loop.settings import LoopSettings, LoopStage
from cluster_est.errors import ProblemError
from cluster_est.problem.compatibility import NOT_PLAIN
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import make_space
from cluster_est.problem.variables import silent_notes
from cluster_est.running.arguments import check_method, check_problem
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.resources import one_blas_thread
from cluster_est.statistics.noise.estimate import SHORTEST_NOISE_RECORD
from cluster_est.statistics.records import make_records
from cluster_est.toml import dotted
from workers.effects.forms import FORMS
from workers.effects.site import EffectSite, open_pairs, open_sites, parse_site
from workers.fmu.description import ModelDescription, nearest
from workers.messages import Output
from workers.messages.checks import check_kind, check_number


@dataclass(frozen=True)
class LoopScope:
    """What a report says of a loop, whatever is found: the open sites, and notes for the reader."""

    sites: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LoopWorkbench:
    """A loop that is open, for its recipe: what the recipe calls is given what it needs.

    Attributes
    ----------
    first_fit
        The declared model from the user's start, where that was needed before.
    near
        Where a fit to data that had outliers ended; empty if there is none.
    """

    fitter: Fitter
    settings: LoopSettings
    scope: LoopScope
    first_fit: FittedModel | None = field(default=None, repr=False)
    near: Mapping[str, float] = field(default_factory=dict)


SAMPLES_PER_UNKNOWN = 4
"""Measured values for each unknown that a loop needs. Benchmark."""


@dataclass(frozen=True)
class LoopRequest:
    """A closed loop, or a part of one, that is to be run.

    Attributes
    ----------
    environment
        Workers, budget, and who is told of the simulations.
    rows
        That are left of each long record while effects are looked for; None for all.
    noise_of_samples
        As far as thinned records are known to have it, by output.
    sigma_declared
        The user has given a sigma; None where that is so if the problem has one.
    """

    problem: Problem
    environment: RunEnvironment = field(default_factory=RunEnvironment)
    settings: LoopSettings = field(default_factory=LoopSettings)
    seed: int = 0
    rows: int | None = None
    noise_of_samples: Mapping[str, float] = field(default_factory=dict)
    sigma_declared: bool | None = None


def check_arguments(problem: Problem, settings: LoopSettings, seed: int) -> None:
    """Refuse what no config would be allowed to ask for.

    Raises
    ------
    ProblemError
        If something is of the wrong kind or out of its range.
    """
    check_problem(problem)
    check_kind(settings, LoopSettings, "closed_loop", ProblemError)
    check_number(seed, "closed_loop.seed", ProblemError, least=0, whole=True)


@contextmanager
def open_workbench(request: LoopRequest) -> Iterator[LoopWorkbench]:
    """Start the workers and install the experiments with their synthetic copies.

    Where several outputs have no sigma, a first fit gives each its own from its noise, or one
    output's unit would decide what is found.
    """
    problem = request.problem
    description = problem.describe()
    _check_shape(problem)
    _check_choices(problem, request.settings, description)
    if request.sigma_declared is None:
        request = replace(request, sigma_declared=_declares_sigma(problem))
    weights: tuple[str, ...] = ()
    outputs = {o.variable for e in problem.experiments for o in e.outputs}
    if len(outputs) > 1 and not _declares_sigma(problem):
        with _opened(request, description) as fitter:
            (fitted,) = fitter.fit(LoopStage.WEIGHTS, [FitStart(problem, {})], BRIEF)
            if fitted is not None:
                noise = noise_of(fitter, fitted.residuals)
                sigmas = dict(zip(fitter.records.outputs, noise.tolist(), strict=True))
                request = replace(request, problem=_weighted(problem, sigmas))
                weights = (_weight_note(request.problem, sigmas),)
    with _opened(request, description) as fitter:
        problem = request.problem
        notes = (*_notes(problem, description), *weights)
        if not fitter.sigma_declared:
            notes += _short_notes(fitter)
        scope = LoopScope(_sites(problem, description), notes)
        yield LoopWorkbench(fitter, request.settings, scope)


@contextmanager
def _opened(request: LoopRequest, description: ModelDescription) -> Iterator[Fitter]:
    """What fits models of a problem as it is."""
    problem = request.problem
    train = problem.indices("train")
    runs = [problem.experiments[e] for e in train]
    installed = list(problem.experiments)
    synthetic: dict[SyntheticKind, tuple[int, ...]] = {}
    for copy in (*SHORTENED, ENLARGED):
        synthetic[copy] = tuple(range(len(installed), len(installed) + len(runs)))
        installed += [copy.of(run) for run in runs]
    everything = replace(problem, experiments=tuple(installed))
    environment = request.environment
    meter = SimulationMeter(everything.experiments, environment.monitor.record)
    with one_blas_thread(), environment.executor(everything) as executor:
        runner = environment.runner(executor, record=meter, whole=True)
        yield Fitter(
            runner=runner,
            problem=problem,
            description=description,
            seed=request.seed,
            train=train,
            records=make_records(runs),
            synthetic=synthetic,
            everything=everything,
            meter=meter,
            noise_of_samples=request.noise_of_samples,
            sigma_declared=bool(request.sigma_declared),
        )
        runner.forget()


def _check_shape(problem: Problem) -> None:
    """Refuse a problem that the tests are not made for, or with too few data."""
    if not problem.plain or not isinstance(problem.cost, SumSquared):
        raise ProblemError(
            "closed loop: the cost must be sse, all outputs must be measured over time, and there "
            "must be no constraints, because the tests of the closed loop are made for this; "
            "remove what differs, and use it in a fit before or after the closed loop"
        )
    for experiment in problem.experiments:
        for output in experiment.outputs:
            if not output.is_plain:
                raise ProblemError(
                    f"closed loop: experiment {experiment.id!r}: output {output.variable} must be "
                    f"compared directly but has {NOT_PLAIN}; the tests of the closed loop need "
                    "residuals that are plain differences, so only a scale that all experiments "
                    'share (free_scale = "shared") is allowed'
                )
    for parameter in problem.parameters:
        if parameter.prior is not None:
            raise ProblemError(
                f"closed loop: {dotted('parameters', parameter.name)}.prior must be left out, "
                "because the tests of the closed loop treat all residuals as residuals "
                "of measurements; remove the prior, and use it in a fit with the effects that were "
                "found"
            )
    train = make_space(problem, problem.indices("train"))
    check_method(BRIEF, train)
    samples = train.rows[-1].stop
    least = SAMPLES_PER_UNKNOWN * (train.size + 1)
    if samples < least:
        raise ProblemError(
            f"closed loop: the training experiments must have at least {least} measured values to "
            f"distinguish a missing effect from {train.size} parameters but have {samples}; add "
            "data or fix parameters"
        )


def _check_choices(problem: Problem, settings: LoopSettings, description: ModelDescription) -> None:
    """Refuse forms and sites that there are not."""
    known = sorted({name for _, name in FORMS})
    for name in settings.forms:
        if name not in known:
            raise ProblemError(
                f"closed_loop.effects: there is no form {name!r}{nearest(name, known)}"
            )
    offered = _sites(problem, description)
    outputs = [site for site in settings.sites if site.startswith("output ")]
    if outputs and noise_names(problem):
        raise ProblemError(
            f"closed_loop.sites: {outputs[0]!r} cannot be used with process noise, because a "
            "Kalman filter uses measured values unchanged; leave one of the two out"
        )
    closed = {f"parameter {name}" for name in _closed_parameters(problem, description)}
    for site in settings.sites:
        if site in closed:
            raise ProblemError(
                f"closed_loop.sites: {site!r} cannot be used, because {description.file} does not "
                "allow it to change during a simulation; export it with variability tunable, or "
                "leave it out"
            )
        if site not in offered:
            raise ProblemError(
                f"closed_loop.sites: {description.file} does not offer the site {site!r}"
                f"{nearest(site, offered)}"
            )
    kinds = {parse_site(site, "closed_loop.sites").kind for site in settings.sites or offered}
    if settings.forms and not any((kind, f) in FORMS for kind in kinds for f in settings.forms):
        raise ProblemError(
            "closed_loop.effects: must name a form for one of the sites, but none of "
            f"{', '.join(settings.forms)} can act at {' or '.join(sorted(kinds))} sites; change "
            "closed_loop.effects or closed_loop.sites"
        )


def _declares_sigma(problem: Problem) -> bool:
    """Return whether some output has a sigma."""
    return any(o.has_sigma for e in problem.experiments for o in e.outputs)


def _weighted(problem: Problem, noise: dict[str, float]) -> Problem:
    def change(_: int, output: Output) -> Output:
        sigma = noise.get(output.variable, np.nan)
        return replace(output, sigma=float(sigma)) if np.isfinite(sigma) and sigma > 0.0 else output

    return with_outputs(problem, change)


def _weight_note(problem: Problem, noise: dict[str, float]) -> str:
    sigmas = {o.variable: o.sigma for e in problem.experiments for o in e.outputs}
    pairs = ", ".join(f"{name} = {sigma:.6g}" for name, sigma in sigmas.items())
    silent = [name for name in sigmas if not noise.get(name, np.nan) > 0.0]
    but = f", except {' and '.join(silent)}, whose noise is not known" if silent else ""
    return (
        "no sigma was given for several outputs, so each was weighted with its estimated noise"
        f"{but}; "
        f"write sigma = {{ {pairs} }} into the experiments for a fit with the same weights"
    )


def _sites(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    interface = problem.model.interface
    pairs = open_pairs(description, interface)
    pairs += [EffectSite("pair", *reversed(site.targets)) for site in pairs]
    measured = {output.variable for e in problem.experiments for output in e.outputs}
    sites = open_sites(description, interface, measured)
    if noise_names(problem):  # beside a filter nothing acts on what is measured
        sites = [site for site in sites if site.kind != "output"]
    return tuple(str(site) for site in [*sites, *pairs])


def _closed_parameters(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    """Return the estimated parameters that the FMU does not allow to change while it runs.

    No effect can act there: a parameter that varies with a state, an input or time stays unseen.
    """
    known = description.variables
    targets = dict.fromkeys(p.target for p in problem.parameters if not p.fixed)
    return tuple(
        name
        for name in targets
        if name in known and known[name].causality == "parameter" and not known[name].tunable
    )


def _short_notes(fitter: Fitter) -> tuple[str, ...]:
    """Name the outputs whose records are all too short to estimate a noise that is not given."""
    records = fitter.records
    short = [
        name
        for number, name in enumerate(records.outputs)
        if len(fitter.sigmas[records.of_output(number)]) and not is_told(records, number)
    ]
    if not short:
        return ()
    return (
        f"no record of {', '.join(short)} has {SHORTEST_NOISE_RECORD} samples, so its noise "
        "cannot be distinguished from missing effects: the whole residual of the declared model "
        "counts as noise, and errors over it have no meaning; give sigma",
    )


def _notes(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    notes = [*silent_notes(problem, description), *problem.notes()]
    closed = _closed_parameters(problem, description)
    if closed:
        notes.append(
            f"closed to effects: {', '.join(closed)}, because {description.file} does not allow "
            f"{'it' if len(closed) == 1 else 'them'} to change while it runs; something missing "
            "that makes such a parameter vary cannot be seen as that; export with variability "
            "tunable to open the site"
        )
    if not problem.indices("test"):
        notes.append(
            'no experiment has role = "test": no held-out data could contradict the finding, and '
            "the errors are from the data that led to it"
        )
    if len(problem.indices("train")) == 1:
        notes.append(
            "there is only one training experiment: for cross-validation, quarters of its record "
            "were predicted from the rest"
        )
    if problem.model.interface == "co_simulation":
        notes.append(
            "co-simulation: state derivatives are not accessible; an effect inside the model can "
            "only appear at an input, an output or a parameter"
        )
    return tuple(notes)
