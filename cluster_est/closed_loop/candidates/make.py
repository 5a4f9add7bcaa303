"""Every effect that could be missing: each form of the library at each site, of each variable."""

from __future__ import annotations

import itertools
import re
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.candidates.equation import equation_text
from cluster_est.closed_loop.candidates.scales import SignalScales
from cluster_est.closed_loop.candidates.shapes import shape_of
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.thresholds import CandidateThresholds
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from workers.effects.forms import (
    FORMS,
    EffectForm,
    FormCoefficient,
    FormCondition,
    GridScale,
    positive,
)
from workers.effects.site import EffectSite, open_pairs, open_sites, parse_site
from workers.fmu.description import ModelDescription
from workers.messages import Effect


@dataclass(frozen=True)
class EffectCandidate:
    """An effect that could be missing.

    Attributes
    ----------
    effect, form, site
        Of the candidate; two candidates with the same effect do not occur.
    own
        Its variable is the state at whose derivative it acts.
    grid
        Values of its coefficients to look at, each a row; strengths that it is linear in are 0.
    lowest, highest
        Bounds of each coefficient for a refit.
    """

    effect: Effect
    form: EffectForm
    site: EffectSite
    own: bool
    grid: tuple[tuple[float, ...], ...]
    lowest: tuple[float, ...] = field(repr=False)
    highest: tuple[float, ...] = field(repr=False)

    @property
    def strengths(self) -> tuple[str, ...]:
        return shape_of(self.form).strengths

    @property
    def equation(self) -> str:
        return equation_text(self.effect, self.form, self.site)

    def parameters(self, values: Sequence[float]) -> tuple[Parameter, ...]:
        """Its coefficients as parameters that start from these values."""
        made = []
        for i, coefficient in enumerate(self.form.coefficients):
            low, high = self.lowest[i], self.highest[i]
            start = float(min(max(values[i], low), high))
            log = low > 0.0 and coefficient.name not in self.strengths
            made.append(
                Parameter(
                    f"{self.effect.name}.{coefficient.name}",
                    start,
                    low,
                    high,
                    "log" if log and not coefficient.held else "linear",
                    fixed=coefficient.held,
                )
            )
        return tuple(made)


def make_candidates(
    problem: Problem,
    description: ModelDescription,
    trajectories: Sequence[LinearisedTrajectory],
    frequencies: Sequence[float],
    settings: LoopSettings,
) -> list[EffectCandidate]:
    """List the candidates that the data can say something about.

    Parameters
    ----------
    problem, description
        Sites that the FMU offers, and effects that are known: those are no candidates.
    trajectories
        Of the training experiments, at the current fit.
    frequencies
        Angular frequencies of peaks in the residuals' spectra, for periodic effects.
    settings
        Forms and sites to try, and thresholds.
    """
    thresholds = settings.thresholds.candidates
    scales = SignalScales(trajectories, frequencies, thresholds)
    exchange = problem.model.interface == "model_exchange"
    known = {_identity(effect) for effect in problem.effects if effect.form}
    taken = {effect.name for effect in problem.effects}
    found = []
    for site in _sites(problem, description, trajectories, thresholds):
        if settings.sites and str(site) not in settings.sites:
            continue
        for form in (f for (kind, _), f in FORMS.items() if kind == site.kind):
            if settings.forms and form.name not in settings.forms:
                continue
            if form.memory and not exchange and not description.variable_steps:
                continue  # it has kinks between the samples, where such an FMU cannot stop
            for variables in _variables(form, site, problem, description, trajectories):
                candidate = _candidate(form, site, variables, scales, taken)
                if candidate and _identity(candidate.effect) not in known:
                    taken.add(candidate.effect.name)
                    found.append(candidate)
    return found


def _identity(effect: Effect) -> tuple[str, str, tuple[str, ...]]:
    """Site, form and variables of an effect, the same however they were written."""
    site = parse_site(effect.site, f"effect {effect.name!r}: site")
    form = FORMS[site.kind, effect.form]
    own = (" - ".join(site.targets),) if form.variables == 1 and site.at_rates else ()
    variables = effect.variables or own
    return str(site), form.name, tuple(sorted(variables))  # those of two are products


def _sites(
    problem: Problem,
    description: ModelDescription,
    trajectories: Sequence[LinearisedTrajectory],
    thresholds: CandidateThresholds,
) -> Iterator[EffectSite]:
    """Sites where something could be missing and would be seen."""
    interface = problem.model.interface
    train = [problem.experiments[e] for e in problem.indices("train")]
    driven = {given.variable for e in train for given in e.inputs}
    driven = {name for name in driven if all(trajectory.has(name) for trajectory in trajectories)}
    measured = {output.variable for e in train for output in e.outputs}
    estimated = {p.target for p in problem.parameters if not p.fixed}
    moving = set(description.states) - kinematic_states(trajectories, thresholds.kinematic)
    for site in open_sites(description, interface, measured):
        wanted = {
            "derivative": moving,
            "input": driven,
            "parameter": estimated - set(description.states),
            "output": set(),
        }
        if site.target in wanted[site.kind]:
            yield site
    for name in sorted(measured):
        yield EffectSite("output", name)
    for site in open_pairs(description, interface):
        if set(site.targets) <= moving:
            yield site
            yield EffectSite("pair", *reversed(site.targets))


def kinematic_states(
    trajectories: Sequence[LinearisedTrajectory],
    tolerance: float = CandidateThresholds.kinematic,
) -> set[str]:
    """States whose derivative is another state: nothing can be missing there."""
    found: set[str] = set()
    for trajectory in trajectories[:1]:
        linear = trajectory.linear
        if linear is None:
            continue
        for i, name in enumerate(linear.state_names):
            j = int(np.argmax(linear.A[0, i]))
            row = np.abs(linear.A[:, i] - np.eye(len(linear.state_names))[j]).max()
            driven = np.abs(linear.B[:, i]).max(initial=0.0)
            size = np.abs(linear.derivatives[:, i]).max()
            gap = np.abs(linear.derivatives[:, i] - linear.states[:, j]).max()
            if i != j and gap <= tolerance * size and max(row, driven) < 1e-4:
                found.add(name)
    return found


def _variables(
    form: EffectForm,
    site: EffectSite,
    problem: Problem,
    description: ModelDescription,
    trajectories: Sequence[LinearisedTrajectory],
) -> Iterator[tuple[str, ...]]:
    """Variables that a form at a site may be a function of."""
    if form.variables == 0:
        yield ()
        return
    exchange = problem.model.interface == "model_exchange"
    states = [s for s in description.states if exchange]
    common = [
        n for n in trajectories[0].signals if all(trajectory.has(n) for trajectory in trajectories)
    ]
    signals = [{s.variable for s in e.signals} for e in problem.experiments]
    lacking = {n for own in signals for n in own if not all(n in others for others in signals)}
    driven = [n for n in common if n not in (*states, *trajectories[0].names, *lacking)]
    if site.kind == "pair":
        yield from _of_pair(form, site, states, description)
        return
    outputs = [n for n in trajectories[0].names if n in common and n not in states]
    names = [*states, *driven, *(outputs if site.kind == "output" else [])]
    if FormCondition.DRIVEN in form.when:
        names = driven
    if FormCondition.OWN in form.when:
        names = [site.target]
    if site.kind in ("input", "output"):
        names = [n for n in names if n != site.target]
    if form.variables == 1:
        yield from ((name,) for name in names)
    else:
        yield from itertools.combinations(names, 2)


def _of_pair(
    form: EffectForm, site: EffectSite, states: Sequence[str], description: ModelDescription
) -> Iterator[tuple[str, ...]]:
    """Differences of states of one unit, and single states: the twist of a shaft may be one.

    A difference points from the second state to the first, so one order of the pair is enough.
    """
    if FormCondition.FIRST in form.when:
        yield (site.targets[0],)
        return
    if states.index(site.targets[0]) < states.index(site.targets[1]):
        for first, second in itertools.combinations(states, 2):
            units = [description.variables[n].unit for n in (first, second)]
            if units[0] == units[1]:
                yield (f"{first} - {second}",)
    yield from ((name,) for name in states if name not in site.targets)


def _candidate(
    form: EffectForm,
    site: EffectSite,
    variables: tuple[str, ...],
    scales: SignalScales,
    taken: Container[str],
) -> EffectCandidate | None:
    """A candidate with its grid; None where the form makes no sense on this data."""
    if not scales.allow(form, site, variables):
        return None
    own = site.kind == "derivative" and variables == (site.target,)
    name = "_".join([form.name, *site.targets, *(() if own else variables)])
    name = re.sub(r"\W+", "_", name)
    while name in taken:
        name += "_2"
    strengths = shape_of(form).strengths
    axes, lows, highs = [], [], []
    for coefficient in form.coefficients:
        values = (
            (0.0,) if coefficient.name in strengths else scales.grid(coefficient, site, variables)
        )
        if not values:
            return None
        low, high = _bounds(coefficient, own, strengths, values, scales, variables)
        axes.append(values)
        lows.append(low)
        highs.append(high)
    grid = tuple(itertools.product(*axes))
    if not np.isfinite(grid).all():
        return None
    effect = Effect(name, str(site), form.name, variables)
    return EffectCandidate(effect, form, site, own, grid, tuple(lows), tuple(highs))


def _bounds(
    coefficient: FormCoefficient,
    own: bool,
    strengths: Sequence[str],
    values: Sequence[float],
    scales: SignalScales,
    variables: tuple[str, ...],
) -> tuple[float, float]:
    """Bounds of a coefficient in a refit."""
    if coefficient.name in strengths:
        return (0.0 if positive(coefficient, own=own) else -np.inf), np.inf
    if coefficient.scale is GridScale.QUANTILE_V:
        v = pooled(scales.trajectories, variables[0])  # moves, once the effect is there
        return float(2.0 * v.min() - v.max()), float(2.0 * v.max() - v.min())
    thresholds = scales.thresholds
    if coefficient.positive:
        return min(values) / thresholds.narrowest, max(values) * thresholds.widest
    width = 10.0 * max(abs(v) for v in values) + 1e-12
    return -width, width
