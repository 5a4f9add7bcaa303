"""Makes the candidates: each form at each site with each variable, and finer versions of them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np

from cluster_est.closed_loop.candidates.arguments import (
    CandidatePlace,
    KinematicDefinition,
    OpenArguments,
    by_site,
    kinematic_definitions,
    open_arguments,
    variables_of,
)
from cluster_est.closed_loop.candidates.array_forms import shape_of
from cluster_est.closed_loop.candidates.scales import SHORTEST_TIME, SignalScales
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, pooled
from cluster_est.closed_loop.settings import LoopPart, LoopSettings
from cluster_est.problem.declared_effects import equation_text
from cluster_est.problem.parameter import Parameter, Scale
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.results.solver_error.finer_solver import communication_step, fixed_step
from workers.effects.forms import FORMS, EffectForm, FormCoefficient, GridScale, positive
from workers.effects.site import EffectSite, open_pairs, open_sites, parse_site, unnamed_variables
from workers.fmu.description import ModelDescription
from workers.messages import Effect, FloatArray

FEWEST_WAVES = 1.5
"""Fewest periods of a wave within the data at the lower end of the grid. By definition: with less
than one period nothing repeats, and the curve is a bend and not a wave."""
BELOW_GRID, ABOVE_GRID = 20.0, 50.0
"""Factors by which a refit may leave the grid of a positive coefficient, below and above."""


@dataclass(frozen=True)
class EffectCandidate:
    """An effect that the model may lack. No two candidates have the same effect.

    Attributes
    ----------
    own
        Whether its variable is the state at whose derivative it acts.
    grid
        Rows of coefficient values to try. Strengths in which the effect is linear are 0.
    lowest, highest
        Bounds of each coefficient for a refit.
    experiments
        Names of the training experiments, if a coefficient has its own value in each experiment.
    """

    effect: Effect
    form: EffectForm
    site: EffectSite
    own: bool
    grid: tuple[tuple[float, ...], ...]
    lowest: tuple[float, ...] = field(repr=False)
    highest: tuple[float, ...] = field(repr=False)
    experiments: tuple[str, ...] = field(default=(), repr=False)

    @cached_property
    def strengths(self) -> tuple[str, ...]:
        return shape_of(self.form).strengths

    @property
    def equation(self) -> str:
        return equation_text(self.effect, self.form, self.site)

    @property
    def label(self) -> str:
        """For example "coulomb at der(v)", or "coulomb(w) at der(v)" for another variable."""
        of = "" if self.own else ", ".join(self.effect.variables)
        return f"{self.form.name}{f'({of})' if of else ''} at {self.site}"

    def counts(self, coefficients: Sequence[FormCoefficient]) -> list[int]:
        """Return how many values each coefficient has: one, or one per experiment."""
        return [len(self.experiments) if c.each else 1 for c in coefficients]

    @property
    def own_strengths(self) -> list[FormCoefficient]:
        """The coefficients that are strengths, in their order."""
        return [c for c in self.form.coefficients if c.name in self.strengths]

    def parameters(self, values: Sequence[float]) -> tuple[Parameter, ...]:
        """Its coefficients as parameters that start from these values."""
        made = []
        for i, (coefficient, own) in enumerate(self._divided(values)):
            low, high = self.lowest[i], self.highest[i]
            start = min(max(float(np.mean(own)), low), high)
            strength, held = coefficient.name in self.strengths, coefficient.held
            scale: Scale = "linear" if strength or held or low <= 0.0 else "log"
            name = f"{self.effect.name}.{coefficient.name}"
            per = "experiment" if coefficient.each else None
            made.append(Parameter(name, start, (low, high), scale, fixed=held, per=per))
        return tuple(made)

    def starts(self, values: Sequence[float]) -> dict[str, float]:
        """Start values by label, for the coefficients that have a value in each experiment."""
        return {
            f"{self.effect.name}.{coefficient.name}[{experiment}]": value
            for coefficient, own in self._divided(values)
            if coefficient.each
            for experiment, value in zip(self.experiments, own, strict=True)
        }

    def in_order(self, known: Mapping[str, float]) -> dict[str, float]:
        """Return interchangeable coefficients by label, swapped; empty if they are in order.

        A fit may move two time constants past each other, so that the slow one becomes the fast.
        """
        pairs = [[f"{self.effect.name}.{n}" for n in pair] for pair in self.form.twins]
        if not pairs or known[pairs[0][0]] <= known[pairs[0][1]]:
            return {}
        names = [f"{self.effect.name}.{c.name}" for c in self.form.coefficients]
        bounds = dict(zip(names, zip(self.lowest, self.highest, strict=True), strict=True))
        swapped = {a: known[b] for one, other in pairs for a, b in ((one, other), (other, one))}
        inside = all(bounds[n][0] <= value <= bounds[n][1] for n, value in swapped.items())
        return swapped if inside else {}

    def point(self, values: Sequence[float]) -> tuple[float, ...]:
        """One value for each coefficient: the mean, if it has several values."""
        return tuple(float(np.mean(own)) for _, own in self._divided(values))

    def sizes(self, values: Sequence[float]) -> list[float]:
        """The values of the strengths; some strengths have one value per experiment."""
        divided = self._divided(values)
        return [v for c, own in divided if c.name in self.strengths for v in own]

    def _divided(self, values: Sequence[float]) -> list[tuple[FormCoefficient, list[float]]]:
        """Each coefficient with its value, or with its values in all experiments.

        If only one value per coefficient is given, the value is used for all experiments.
        """
        coefficients, given = self.form.coefficients, iter(values)
        alone = len(values) == len(coefficients)
        return [
            (c, [next(given)] * count if alone else [next(given) for _ in range(count)])
            for c, count in zip(coefficients, self.counts(coefficients), strict=True)
        ]


def make_candidates(
    problem: Problem,
    description: ModelDescription,
    trajectories: Sequence[LinearisedTrajectory],
    frequencies: Sequence[float],
    settings: LoopSettings,
    places: Collection[CandidatePlace] | None = None,
    *,
    beside: Collection[EffectCandidate] = (),
) -> list[EffectCandidate]:
    """List the candidates on which the data contain information.

    Parameters
    ----------
    frequencies
        Angular frequencies of peaks in the residuals' spectra, for periodic effects.
    places
        Places at which functions of a variable are tried; None for all places.
    beside
        Candidates that were already tried. If given, only the other candidates at `places` are
        listed, including the forms that are tried later.
    """
    exchanged, step = communication_step(problem.model, description), fixed_step(problem.model)
    arguments = open_arguments(problem, description, trajectories)
    units = {v.name: v.unit for v in description.variables.values()}
    scales = SignalScales(trajectories, frequencies, exchanged, step, units)
    effects = [*problem.effects, *(candidate.effect for candidate in beside)]
    known = {_identity(e) for e in effects if e.form and not e.is_noise}
    taken = {effect.name for effect in effects}
    opened, leading = OpenSites(problem, description, trajectories, settings), by_site(places or ())
    training = tuple(problem.experiments[e].id for e in problem.indices("train"))
    pairs = [site for site in leading if site.kind == "pair"]
    sites = opened.all if places is None else [*opened.single, *pairs]
    if beside:
        sites = list(leading)
    found = []
    for site in sites:
        names = None if places is None else leading.get(site, [])
        for form in opened.forms_at(site, later=bool(beside)):
            for variables in variables_of(form, site, arguments, names):
                if (str(site), form.name, tuple(sorted(variables))) in known:
                    continue
                candidate = _candidate(form, site, variables, scales, taken, arguments)
                if candidate and any(c.each for c in form.coefficients):
                    candidate = replace(candidate, experiments=training)
                if candidate:
                    taken.add(candidate.effect.name)
                    found.append(candidate)
    return found


def _identity(effect: Effect) -> tuple[str, str, tuple[str, ...]]:
    """Site, form and variables of an effect, independent of how the effect was written."""
    site = parse_site(effect.site, f"effect {effect.name!r}: site")
    form = FORMS[site.kind, effect.form]
    variables = effect.variables or unnamed_variables(form, site)
    return str(site), form.name, tuple(sorted(variables))  # forms of two variables are products


def _candidate(
    form: EffectForm,
    site: EffectSite,
    variables: tuple[str, ...],
    scales: SignalScales,
    taken: Container[str],
    arguments: OpenArguments,
) -> EffectCandidate | None:
    """A candidate with its grid; None if the form makes no sense for these data."""
    if not scales.allow(form, site, variables):
        return None
    own = site.kind == "derivative" and variables == (site.target,)
    way = arguments.pushed_by(site).get(variables[0], 0) if variables else 0
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
        low, high = _bounds(
            coefficient, way, strengths, values, scales, variables, free=bool(form.memory)
        )
        stopped = _stopped_by(coefficient, form, site)
        if stopped:
            steepest = scales.steepest(stopped, variables[0])
            low, high = max(low, -steepest), min(high, steepest)
        axes.append(values)
        lows.append(low)
        highs.append(high)
    grid = tuple(itertools.product(*axes))
    if not np.isfinite(grid).all():
        return None
    effect = Effect(name, str(site), form.name, variables)
    return EffectCandidate(effect, form, site, own, grid, tuple(lows), tuple(highs))


def _stopped_by(coefficient: FormCoefficient, form: EffectForm, site: EffectSite) -> str:
    """Return the state on whose derivative a slope with a threshold acts; "" for other slopes."""
    if not site.at_rates or not any(c.name == "at" for c in form.coefficients):
        return ""
    return {"site / v": site.target, "other / v": site.other}.get(coefficient.unit, "")


def _bounds(
    coefficient: FormCoefficient,
    way: int,
    strengths: Sequence[str],
    values: Sequence[float],
    scales: SignalScales,
    variables: tuple[str, ...],
    *,
    free: bool,
) -> tuple[float, float]:
    """Bounds of a coefficient in a refit; `way` is the sign of the effect on its own variable.

    If `free`, as for a delay of an input, a short time costs the solver nothing: it has no minimum.
    """
    if coefficient.name in strengths:
        if not positive(coefficient, own=way != 0):
            return -np.inf, np.inf
        return (0.0, np.inf) if way >= 0 else (-np.inf, 0.0)
    if coefficient.scale is GridScale.QUANTILE_V:
        v = pooled(scales.trajectories, variables[0])  # its range changes once the effect acts
        return float(2.0 * v.min() - v.max()), float(2.0 * v.max() - v.min())
    if coefficient.scale is GridScale.EXPONENT:
        return 0.125, 8.0
    if coefficient.scale is GridScale.DAMPING:
        return 0.001, 1.0
    if coefficient.scale is GridScale.SHARE:
        return 0.0, 1.0
    if coefficient.positive:
        low = min(values) / BELOW_GRID
        if coefficient.scale is GridScale.STEP and not free:
            low = max(low, SHORTEST_TIME * scales.resolution)
        if coefficient.scale in (GridScale.WAVES_V, GridScale.WAVES_TRAVEL_V):
            low = min(values) / FEWEST_WAVES
        return low, max(values) * ABOVE_GRID
    width = 10.0 * max(abs(v) for v in values) + 1e-12
    return -width, width


def _is_first(form: EffectForm) -> bool:
    """Return whether a form is tried first. Free filters are tried only if no other form passes."""
    return not form.finer_than and not form.is_dynamics


@final
@dataclass(frozen=True)
class OpenSites:
    """The sites at which the model may lack an effect, and the forms to try there.

    If the user has chosen sites or forms, only those are used.
    """

    problem: Problem
    description: ModelDescription
    trajectories: Sequence[LinearisedTrajectory]
    settings: LoopSettings

    @property
    def all(self) -> list[EffectSite]:
        return [*self.single, *self._chosen(self._pairs())]

    @property
    def single(self) -> list[EffectSite]:
        """The sites that are not pairs of states."""
        problem, states = self.problem, self.description.states
        train = [problem.experiments[e] for e in problem.indices("train")]
        driven = {given.variable for e in train for given in e.inputs}
        measured = {output.variable for e in train for output in e.outputs}
        wanted = {
            "derivative": self._moving(),
            "input": {name for name in driven if all(each.has(name) for each in self.trajectories)},
            "parameter": {p.target for p in problem.parameters if not p.fixed} - set(states),
            "output": set(),
        }
        offered = open_sites(self.description, problem.model.interface, measured)
        sites = [site for site in offered if site.target in wanted[site.kind]]
        if not noise_names(problem):  # with a Kalman filter, no effect acts on measured outputs
            sites += [EffectSite("output", name) for name in sorted(measured)]
        return self._chosen(sites)

    def forms_at(self, site: EffectSite, *, later: bool = False) -> list[EffectForm]:
        """Return the forms to try at a site; if `later`, including those that are tried later."""
        forms, model = self.settings.forms, self.problem.model
        timed = LoopPart.FUNCTIONS_OF_TIME not in self.settings.without
        exchange = model.interface == "model_exchange"
        kinks = (exchange or self.description.variable_steps) and not noise_names(self.problem)
        return [
            form
            for (kind, name), form in FORMS.items()
            if kind == site.kind
            and (timed or not form.of_time_alone)
            and (name in forms if forms else _is_first(form) and form.later <= later)
            and (kinks or not form.memory)  # a delay needs values between the samples
        ]

    def _chosen(self, sites: Sequence[EffectSite]) -> list[EffectSite]:
        chosen = self.settings.sites
        return [site for site in sites if not chosen or str(site) in chosen]

    def _pairs(self) -> list[EffectSite]:
        """The pairs of states between which the model may lack a force, in both orders."""
        moving = self._moving()
        offered = open_pairs(self.description, self.problem.model.interface)
        pairs = [site for site in offered if set(site.targets) <= moving]
        return [
            each for site in pairs for each in (site, EffectSite("pair", *reversed(site.targets)))
        ]

    def _moving(self) -> set[str]:
        """The states whose derivatives may lack a term."""
        return set(self.description.states) - {each.state for each in self.definitions}

    @cached_property
    def definitions(self) -> tuple[KinematicDefinition, ...]:
        """The kinematic equations in which nothing can be missing, unless the user names them."""
        sites = [parse_site(text, "closed_loop.sites") for text in self.settings.sites]
        named = {state for site in sites if site.at_rates for state in site.targets}
        known = kinematic_definitions(self.problem, self.description, self.trajectories)
        return tuple(each for each in known if each.state not in named)

    @property
    def searched(self) -> tuple[str, ...]:
        """The sites at which a form can be tried."""
        return tuple(str(site) for site in self.all if self.forms_at(site))


BETWEEN = 4
"""Number of intervals into which a denser grid divides each interval of the candidate's grid."""
BEGINNINGS = np.linspace(0.04, 0.96, 24)
"""Quantiles of the argument at which an effect may set in."""
DENSE_GRID = 12
"""Number of grid points above which a grid is already dense, such as the grid of a wave."""


def denser_grid(
    candidate: EffectCandidate, trajectories: Sequence[LinearisedTrajectory]
) -> list[tuple[float, ...]]:
    """Return a denser grid of the single coefficient that varies in the candidate's own grid.

    The threshold of an effect must be nearly right; otherwise the effect seems to explain less than
    an effect without a threshold. A grid that varies several coefficients is returned unchanged.
    """
    rows = np.array(candidate.grid)
    moving = np.flatnonzero(np.ptp(rows, axis=0) > 0.0)
    if len(moving) != 1 or len(rows) > DENSE_GRID:
        return list(candidate.grid)
    position = int(moving[0])
    if candidate.form.coefficients[position].scale is GridScale.QUANTILE_V:
        argument = pooled(trajectories, candidate.effect.variables[0])
        values = np.asarray(np.quantile(argument, BEGINNINGS))
    else:
        values = _with_more_between(np.sort(rows[:, position]))
    dense = np.repeat(rows[:1], len(values), axis=0)
    dense[:, position] = values
    return [tuple(row) for row in dense.tolist()]


def _with_more_between(known: FloatArray) -> FloatArray:
    at = np.linspace(0.0, len(known) - 1.0, (len(known) - 1) * BETWEEN + 1)
    if (known > 0.0).all():
        return np.exp(np.interp(at, np.arange(len(known)), np.log(known)))
    return np.interp(at, np.arange(len(known)), known)


RARE = 0.005
"""Share of the samples at each end of the range over which a curve stays constant."""


def finer_form(coarse: EffectCandidate) -> EffectForm | None:
    """Return a curve's form with twice as many steps, or a filter's of the next higher order.

    None for the finest.
    """
    kind, name = coarse.site.kind, coarse.form.name
    return next((f for (k, _), f in FORMS.items() if (k, f.finer_than) == (kind, name)), None)


def in_finer_form(coarse: EffectCandidate, form: EffectForm) -> EffectCandidate:
    """Return a free curve or filter with more values, but with the same range and bounds."""
    given = {c.name: i for i, c in enumerate(coarse.form.coefficients)}
    like = [given.get(c.name, given[coarse.strengths[0]]) for c in form.coefficients]
    name = coarse.effect.name.replace(coarse.form.name, form.name, 1)
    return replace(
        coarse,
        effect=replace(coarse.effect, name=name, form=form.name),
        form=form,
        grid=tuple(tuple(values[i] for i in like) for values in coarse.grid),
        lowest=tuple(coarse.lowest[i] for i in like),
        highest=tuple(coarse.highest[i] for i in like),
    )


def refined(
    coarse: EffectCandidate,
    values: Sequence[float],
    trajectories: Sequence[LinearisedTrajectory],
    form: EffectForm,
) -> tuple[EffectCandidate, list[float]]:
    """Return a finer curve or filter with the same values as a fitted coarser one.

    With the effect, the trajectory may leave the range that it had without. If all values of a
    curve are unknowns, the finer curve covers the range that its argument has with the effect.
    """
    known = dict(zip([c.name for c in coarse.form.coefficients], values, strict=True))
    if form.is_dynamics:
        return in_finer_form(coarse, form), [known.get(c.name, 0.0) for c in form.coefficients]
    ends = known["low"], known["high"]
    if len(coarse.strengths) == coarse.form.values:
        v = pooled(trajectories, coarse.effect.variables[-1])
        ends = float(np.quantile(v, RARE)), float(np.quantile(v, 1.0 - RARE))
    points = np.linspace(known["low"], known["high"], coarse.form.values)
    heights = [known.get(f"k{i + 1}", 0.0) for i in range(coarse.form.values)]
    at = np.linspace(*ends, form.values)
    known |= {f"k{i + 1}": y for i, y in enumerate(np.interp(at, points, heights).tolist())}
    known |= {"low": ends[0], "high": ends[1]}
    finer = in_finer_form(coarse, form)
    return _held(finer, known), [known[c.name] for c in form.coefficients]


def _held(candidate: EffectCandidate, known: dict[str, float]) -> EffectCandidate:
    """Return a curve whose bounds and grid contain the values of its held coefficients."""
    held = {i: known[c.name] for i, c in enumerate(candidate.form.coefficients) if c.held}
    low, high = list(candidate.lowest), list(candidate.highest)
    for i, value in held.items():
        low[i], high[i] = min(low[i], value), max(high[i], value)
    grid = tuple(
        tuple(held.get(i, value) for i, value in enumerate(values)) for values in candidate.grid
    )
    return replace(candidate, grid=grid, lowest=tuple(low), highest=tuple(high))
