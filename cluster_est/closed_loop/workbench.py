"""Preparation of a search: checks of the problem, start of the workers, and first notes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
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
from cluster_est.problem.sigmas import declares_sigma
from cluster_est.problem.variables import silent_notes
from cluster_est.running.arguments import check_method, check_problem
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.resources import one_blas_thread
from cluster_est.statistics.noise.estimate import SHORTEST_NOISE_RECORD
from cluster_est.statistics.records import make_records
from cluster_est.toml import dotted
from workers.effects.forms import FORMS, other_forms
from workers.effects.site import EffectSite, open_pairs, open_sites, parse_site
from workers.fmu.description import ModelDescription, nearest
from workers.messages import Output
from workers.messages.checks import check_kind, check_number


@dataclass(frozen=True)
class LoopScope:
    """The sites that the FMU offers, and notes that each report shows.

    `inputs` contains inputs that may need a hold, each with a note.
    """

    sites: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    inputs: tuple[tuple[str, str], ...] = ()

    def notes_on_inputs(self, settled: Collection[str]) -> tuple[str, ...]:
        """Return the notes on inputs, except those whose interpolation is known to be right."""
        return tuple(said for name, said in self.inputs if name not in settled)


@dataclass(frozen=True)
class LoopWorkbench:
    """Everything that the steps of a search need: a fitter with running workers, and the settings.

    Attributes
    ----------
    first_fit
        The declared model, fitted from the user's start values; None if it is not fitted yet.
    near
        The estimates of a fit to the data with outliers; empty if there was no such fit.
    """

    fitter: Fitter
    settings: LoopSettings
    scope: LoopScope
    first_fit: FittedModel | None = field(default=None, repr=False)
    near: Mapping[str, float] = field(default_factory=dict)


SAMPLES_PER_UNKNOWN = 4
"""Least number of measured values per unknown. Benchmark."""


@dataclass(frozen=True)
class LoopRequest:
    """The arguments of a search for missing effects, or of a part of one.

    Attributes
    ----------
    environment
        Workers, budget, and the listener to which simulations are reported.
    rows
        Number of rows to which long records are thinned during the search; None for all rows.
    noise_of_samples
        The noise between the samples of thinned records, by output, if it is known.
    sigma_declared
        Whether the user has given a sigma. If None, this is decided by whether an output has one.
    """

    problem: Problem
    environment: RunEnvironment = field(default_factory=RunEnvironment)
    settings: LoopSettings = field(default_factory=LoopSettings)
    seed: int = 0
    rows: int | None = None
    noise_of_samples: Mapping[str, float] = field(default_factory=dict)
    sigma_declared: bool | None = None


def check_arguments(problem: Problem, settings: LoopSettings, seed: int) -> None:
    """Refuse arguments that would also be wrong in a config.

    Raises
    ------
    ProblemError
        If an argument has the wrong type or is out of its range.
    """
    check_problem(problem)
    check_kind(settings, LoopSettings, "closed_loop", ProblemError)
    check_number(seed, "closed_loop.seed", ProblemError, least=0, whole=True)


@contextmanager
def open_workbench(request: LoopRequest) -> Iterator[LoopWorkbench]:
    """Start the workers and install the experiments with their synthetic copies.

    If there are several outputs and their sigmas are not declared, a first fit estimates the noise
    of each output, which is then used as its sigma. Otherwise the result would depend on the
    outputs' units.
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
                some = any(o.has_sigma for e in problem.experiments for o in e.outputs)
                weights = (_weight_note(request.problem, sigmas, some=some),)
    with _opened(request, description) as fitter:
        problem = request.problem
        notes = (*_notes(problem, description), *weights)
        if not fitter.sigma_declared:
            notes += _short_notes(fitter)
        scope = LoopScope(_sites(problem, description), notes, problem.input_notes())
        yield LoopWorkbench(fitter, request.settings, scope)


@contextmanager
def _opened(request: LoopRequest, description: ModelDescription) -> Iterator[Fitter]:
    """Start the workers for a problem, and yield a fitter."""
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
    """Refuse a problem with too few data, or to which the statistical tests do not apply."""
    if not problem.plain or not isinstance(problem.cost, SumSquared):
        raise ProblemError(
            "close-loop: the tests of the search need the cost sse, outputs that are measured over "
            "time, and no constraints, but the problem has another cost, other outputs or "
            "constraints; remove them, or use them only in a fit before or after the search"
        )
    for experiment in problem.experiments:
        for output in experiment.outputs:
            if not output.is_plain:
                raise ProblemError(
                    f"close-loop: experiment {experiment.id!r}: output {output.variable} must be "
                    f"compared directly with the simulation, but it has {NOT_PLAIN}; the tests of "
                    "the search for missing effects need residuals that are plain differences; "
                    "remove these keys (a scale that all experiments share, free_scale = "
                    '"shared", is allowed)'
                )
    for parameter in problem.parameters:
        if parameter.prior is not None:
            raise ProblemError(
                f"close-loop: {dotted('parameters', parameter.name)}.prior must not be used, "
                "because the tests of the search treat all residuals as residuals of measurements; "
                "remove the prior, or use it only in a later fit with the effects that were found"
            )
    train = make_space(problem, problem.indices("train"))
    check_method(BRIEF, train)
    samples = train.rows[-1].stop
    least = SAMPLES_PER_UNKNOWN * (train.size + 1)
    if samples < least:
        raise ProblemError(
            f"close-loop: the training experiments must have at least {least} measured values, so "
            f"that a missing effect can be distinguished from {train.size} parameters, but they "
            f"have {samples}; add data or fix parameters"
        )


def _check_choices(problem: Problem, settings: LoopSettings, description: ModelDescription) -> None:
    """Refuse unknown forms, and sites at which no effect can act."""
    known = {name for _, name in FORMS}
    for name in settings.forms:
        if name not in known:
            raise ProblemError(
                f"closed_loop.effects: there is no form {name!r}{other_forms(name, FORMS.values())}"
            )
    offered = _sites(problem, description)
    outputs = [site for site in settings.sites if site.startswith("output ")]
    if outputs and noise_names(problem):
        raise ProblemError(
            f"closed_loop.sites: {outputs[0]!r} cannot be used with process noise, because a "
            "Kalman filter uses measured values unchanged; remove this site or the process noise"
        )
    closed = {f"parameter {name}" for name in _closed_parameters(problem, description)}
    for site in settings.sites:
        if site in closed:
            raise ProblemError(
                f"closed_loop.sites: {site!r} cannot be used, because {description.file} does not "
                "allow this parameter to change during a simulation; export the FMU with "
                "variability tunable for this parameter, or remove the site"
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
            f"{', '.join(settings.forms)} can act at sites of the kind "
            f"{' or '.join(sorted(kinds))}; change closed_loop.effects or closed_loop.sites"
        )


def _declares_sigma(problem: Problem) -> bool:
    """Return whether the sigmas of the training experiments are declared."""
    return declares_sigma(o for e in problem.experiments if e.role == "train" for o in e.outputs)


def _weighted(problem: Problem, noise: dict[str, float]) -> Problem:
    def change(_: int, output: Output) -> Output:
        level = float(noise.get(output.variable, np.nan))
        if not (np.isfinite(level) and level > 0.0):
            return output
        relative = level * output.relative_sigma
        return replace(
            output, sigma=level * output.sigma, relative_sigma=relative, sigma_known=True
        )

    return with_outputs(problem, change)


def _weight_note(problem: Problem, noise: dict[str, float], *, some: bool) -> str:
    sigmas: dict[str, list[float]] = {}
    for output in (o for e in problem.experiments for o in e.outputs):
        sigmas.setdefault(output.variable, []).append(output.sigma)
    silent = [name for name in sigmas if not noise.get(name, np.nan) > 0.0]
    but = f", except {' and '.join(silent)}, whose noise is not known" if silent else ""
    said = (
        f"{'not every' if some else 'no'} sigma of the outputs is known, so each output was "
        f"weighted with its estimated noise{but}"
    )
    if any(len({*own}) > 1 for own in sigmas.values()):  # then no single line has these weights
        return said
    pairs = ", ".join(f"{name} = {own[0]:.6g}" for name, own in sigmas.items())
    return (
        f"{said}; for a fit with the same weights, write sigma = {{ {pairs} }} and sigma_known = "
        "false into the experiments"
    )


def _sites(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    interface = problem.model.interface
    pairs = open_pairs(description, interface)
    pairs += [EffectSite("pair", *reversed(site.targets)) for site in pairs]
    measured = {output.variable for e in problem.experiments for output in e.outputs}
    sites = open_sites(description, interface, measured)
    if noise_names(problem):  # a Kalman filter uses measured values unchanged
        sites = [site for site in sites if site.kind != "output"]
    return tuple(str(site) for site in [*sites, *pairs])


def _closed_parameters(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    """Return the estimated parameters that the FMU does not allow to change during a simulation.

    No effect can act on them, so the search cannot find that such a parameter varies.
    """
    known = description.variables
    targets = dict.fromkeys(p.target for p in problem.parameters if not p.fixed)
    return tuple(
        name
        for name in targets
        if name in known and known[name].causality == "parameter" and not known[name].tunable
    )


def _short_notes(fitter: Fitter) -> tuple[str, ...]:
    """Return a note on outputs whose records are all too short to estimate the noise."""
    records = fitter.records
    short = [
        name
        for number, name in enumerate(records.outputs)
        if len(fitter.sigmas[records.of_output(number)]) and not is_told(records, number)
    ]
    if not short:
        return ()
    return (
        f"all records of {' and '.join(short)} have fewer than {SHORTEST_NOISE_RECORD} samples, so "
        "their noise cannot be distinguished from missing effects: the whole residual of the "
        "declared model counts as noise, and errors divided by this noise have no meaning; give a "
        "sigma",
    )


def _notes(problem: Problem, description: ModelDescription) -> tuple[str, ...]:
    notes = [*silent_notes(problem, description), *problem.model_notes(), *problem.data_notes()]
    closed = _closed_parameters(problem, description)
    if closed:
        named = f"parameter{'s' if len(closed) > 1 else ''} {' and '.join(closed)}"
        notes.append(
            f"no effect can act on the {named}, because {description.file} does not allow a change "
            "during a simulation; if such a parameter varies in reality, the search cannot find "
            "this; to make it possible, export the FMU with variability tunable for the parameter"
        )
    if not problem.indices("test"):
        notes.append(
            'no experiment has role = "test", so the result was not checked on held-out data: all '
            "errors are those of the data that the search used"
        )
    if len(problem.indices("train")) == 1:
        notes.append(
            "there is only one training experiment, so cross-validation predicts each quarter of "
            "its record from the other three quarters"
        )
    if problem.model.interface == "co_simulation":
        notes.append(
            "in co-simulation, state derivatives are not accessible, so effects are searched only "
            "at inputs, outputs and parameters"
            + (
                '; to search the state equations too, set model.interface = "model_exchange"'
                if "model_exchange" in description.interfaces
                else ""
            )
        )
    return tuple(notes)
