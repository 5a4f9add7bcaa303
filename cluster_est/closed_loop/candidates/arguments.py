"""The arguments that an effect at a site may depend on, and the places that follow from them."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import (
    CONSTANT_FACTOR,
    LinearisedTrajectory,
    integrated_states,
)
from cluster_est.problem.dimensions import (
    ANGLE,
    BALANCED,
    LENGTH,
    NUMBER,
    Dimension,
    KnownUnits,
    integral_of,
)
from cluster_est.problem.problem import Problem
from workers.effects.forms import EffectForm, FormCondition
from workers.effects.laws import Law
from workers.effects.site import EffectSite, difference, is_difference
from workers.fmu.description import ModelDescription

ACTS = 1e-9
"""Share of a state's largest derivative below which a signal does not count as acting on it."""


FIRST_OF_READ = (Law.LINEAR, Law.SQUARE, Law.PRODUCT_WITH_SIGNAL, Law.STORE)
"""Laws that are tried first where a parameter or an input may depend on an output: each candidate
takes a simulation. Other laws are tried only at the places where these laws explain most."""

TIME = ""
"""The argument of an effect that depends on time alone: a constant, a drift or a wave."""


@dataclass(frozen=True)
class CandidatePlace:
    """A site, and the argument of a possible missing function; `TIME` for a function of time."""

    site: EffectSite
    argument: str


def by_site(places: Collection[CandidatePlace]) -> dict[EffectSite, list[str]]:
    """Return the arguments at each site."""
    found: dict[EffectSite, list[str]] = {}
    for place in places:
        found.setdefault(place.site, []).append(place.argument)
    return found


@dataclass(frozen=True)
class KinematicDefinition:
    """An equation dx/dt = v that only defines the speed v of a position or an angle x.

    Nothing can be missing in it. `certain` says whether this follows from the units.
    """

    state: str
    speed: str
    certain: bool


def kinematic_definitions(
    problem: Problem, description: ModelDescription, trajectories: Sequence[LinearisedTrajectory]
) -> list[KinematicDefinition]:
    """Return the equations dx/dt = v of positions, angles and states of unknown quantities.

    The same equation is a balance if x is a volume, a charge or another conserved quantity. A term
    of a balance may be missing, such as a leak.
    """
    units = KnownUnits(description, dict(problem.units))
    found = []
    for state, (speed, factor) in integrated_states(trajectories).items():
        if abs(factor - 1.0) >= CONSTANT_FACTOR:
            continue
        certain = _is_position(units.of(state), units.of(speed))
        if certain is not False:
            found.append(KinematicDefinition(state, speed, bool(certain)))
    return found


def _is_position(own: Dimension | None, rate: Dimension | None) -> bool | None:
    """Return whether a state is a position or an angle; None if the units leave it open.

    A dimensionless state may be an angle or a share, such as a state of charge. The rate of a
    voltage in V/s is no flow, so the equation may be the definition of this rate.
    """
    integral = None if rate is None else integral_of(rate)
    known = [d for d in (own, integral) if d is not None and d != NUMBER]
    if not known:
        return None
    if own is not None and integral is not None and own.without_angle != integral.without_angle:
        return False  # a factor of 1 that has a unit, such as the area of a tank
    if known[0].same_as(*BALANCED):
        return False
    return known[0].same_as(LENGTH, ANGLE) or None


@dataclass(frozen=True)
class OpenArguments:
    """All signals that an effect may depend on, in the given data.

    Attributes
    ----------
    states, units
        The states of the FMU, and their units. There are none in co-simulation.
    driven
        Inputs and measured signals that exist in every experiment.
    outputs
        Measured outputs that are not states.
    pushed
        For each input, the states whose derivatives it acts on, with the sign of its action: 1 or
        -1, or 0 where the sign changes along the data.
    speeds
        For each state that is the integral of another state, that other state.
    surroundings
        For each state, the inputs that have its unit and act on its derivative: an ambient
        temperature, a road, a pressure outside. A flow to them depends on the difference.
    relative
        For each state, the differences between the state, or its integral, and an input that has
        the same unit and acts on the state's derivative. Example: the force of a spring between a
        wheel and the road is a function of the spring's deflection.
    no_ways
        States and signals whose integral is not a useful argument, because the integral is itself
        a state, or because the unit is known and is not a rate. The integral of a flow may be the
        angle of a pump; the integral of a temperature has no such meaning.
    feeds
        For each output, the inputs that act on it directly and not through states. An effect that
        is missing in such an output may be one more term of a balance.
    read
        In co-simulation, the outputs that a parameter or an input may depend on.
    """

    states: tuple[str, ...]
    driven: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    pushed: Mapping[str, Mapping[str, int]]
    speeds: Mapping[str, str]
    surroundings: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    relative: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    no_ways: frozenset[str] = frozenset()
    feeds: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    read: tuple[str, ...] = ()

    def at(self, site: EffectSite) -> list[str]:
        """Return the arguments of functions of one variable at a site.

        At a pair of states, the arguments are the first state of the pair, differences of states
        of one unit, and single other states. For example, the twist of a shaft is a difference. A
        difference points from the second state to the first, so one order of the pair is enough.
        """
        if site.kind == "pair":
            first, second = (self.states.index(name) for name in site.targets)
            differences = (
                [difference(*names) for names in self._of_one_unit] if first < second else []
            )
            others = [name for name in self.states if name not in site.targets]
            return [site.targets[0], *differences, *others]
        names = [*self.states, *self.driven, *(self.outputs if site.kind == "output" else ())]
        if site.kind == "derivative":
            return [*names, *self.relative.get(site.target, ()), *self.between_states]
        if site.kind == "parameter":
            relative = dict.fromkeys(itertools.chain(*self.relative.values()))
            return [*names, *self.read, *relative]
        if site.kind == "input":
            names += self.read
        return [n for n in names if site.kind not in ("input", "output") or n != site.target]

    def around(self, site: EffectSite) -> list[tuple[str, str]]:
        """Return each state with a signal around it: an input of its unit, or the other state."""
        if site.kind == "pair":
            first, second = site.targets
            alike = self.units[first] and self.units[first] == self.units[second]
            ordered = self.states.index(first) < self.states.index(second)
            return [(first, second)] if alike and ordered else []
        return [(site.target, name) for name in self.surroundings.get(site.target, ())]

    def single(self, names: Collection[str]) -> list[str]:
        """Return the arguments that are not differences; only these are used in products."""
        return [name for name in names if name in self.states or not is_difference(name)]

    def beside(self, site: EffectSite, names: Collection[str]) -> list[str]:
        """Return the second arguments of functions whose first one is a state that the site pushes.

        These are the given arguments, and the positions whose derivatives are pushed states, but
        not the pushed states themselves: the friction of a body may depend on its position.
        """
        pushed = self.pushed_by(site)
        places = [x for x, v in self.speeds.items() if v in pushed and x in self.states]
        return [n for n in dict.fromkeys([*self.single(names), *places]) if n not in pushed]

    def carriers(self, site: EffectSite) -> list[str]:
        """Return the signals with which the strength of an exchange between two states may grow."""
        return [n for n in (*self.driven, *self.states) if n not in site.targets]

    @cached_property
    def _of_one_unit(self) -> list[tuple[str, str]]:
        pairs = itertools.combinations(self.states, 2)
        return [(a, b) for a, b in pairs if self.units[a] == self.units[b]]

    @cached_property
    def between_states(self) -> dict[str, tuple[str, str]]:
        """The differences of two states of one unit, each with its two states."""
        return {difference(*names): names for names in self._of_one_unit}

    def takes(self, form: EffectForm, site: EffectSite, argument: str) -> bool:
        """Return whether a form of one variable at a site can have this argument."""
        if site.kind == "pair":
            first, second = (self.states.index(name) for name in site.targets)
            if form.free and first > second:  # the same curve with the opposite sign
                return False
            return (argument == site.targets[0]) is (FormCondition.FIRST in form.when)
        if argument in self.between_states and not form.differences:
            return False
        pushed, state = self.pushed_by(site), argument in self.states
        refused = {
            FormCondition.STATE: not state,
            FormCondition.DRIVEN: argument not in self.driven,
            FormCondition.FEEDS: argument not in self.feeds.get(site.target, ()),
            FormCondition.FORCE: argument not in self.read and (len(pushed) < 2 or not state),
            FormCondition.POSITION: self.speeds.get(argument) not in pushed,
            FormCondition.NO_POSITION: argument in self.no_ways,
            FormCondition.OTHER: argument in pushed,
            FormCondition.DIFFERENCE: state or not is_difference(argument),
            FormCondition.OWN: argument not in pushed,
        }
        return not any(refused.get(condition, False) for condition in form.when)

    def pushed_by(self, site: EffectSite) -> Mapping[str, int]:
        """Return the states that an added term at a derivative or input acts on, with its sign."""
        return self.pushed.get(site.target, {}) if site.kind == "input" else {site.target: 1}


def open_arguments(
    problem: Problem, description: ModelDescription, trajectories: Sequence[LinearisedTrajectory]
) -> OpenArguments:
    """Return the arguments that an effect may have: the signals of all training experiments."""
    exchange = problem.model.interface == "model_exchange"
    states = tuple(s for s in description.states if exchange)
    common = [
        n for n in trajectories[0].signals if all(trajectory.has(n) for trajectory in trajectories)
    ]
    signals = [{s.variable for s in e.signals} for e in problem.experiments]
    lacking = {n for own in signals for n in own if not all(n in others for others in signals)}
    names = trajectories[0].names
    outputs = tuple(n for n in names if n in common and n not in states)
    units = {name: description.variables[name].unit for name in states}
    pushed = _pushed(trajectories, states)
    around = _inputs_of_one_unit(description, units, pushed, common)
    speeds = {x: v for x, (v, _) in integrated_states(trajectories).items()}
    known = KnownUnits(description, dict(problem.units))
    dimensions = {name: known.of(name) for name in (*states, *common)}
    others = {n for n, d in dimensions.items() if d is not None and not (d.is_rate or d == NUMBER)}
    return OpenArguments(
        states=states,
        driven=tuple(n for n in common if n not in (*states, *names, *lacking)),
        outputs=outputs,
        units=units,
        pushed=pushed,
        speeds=speeds,
        surroundings=_surroundings(around, pushed),
        relative=_relative(around, pushed, states, speeds),
        no_ways=frozenset({*speeds.values(), *others}),
        feeds=_feeds(trajectories, description),
        read=() if exchange else outputs,
    )


def _inputs_of_one_unit(
    description: ModelDescription,
    units: Mapping[str, str],
    inputs: Collection[str],
    known: Collection[str],
) -> dict[str, list[str]]:
    """For each state, the inputs of its unit (if it has a unit) that exist in all experiments."""
    driven = [name for name in inputs if name in known]
    return {
        state: [u for u in driven if unit and u != state and description.variables[u].unit == unit]
        for state, unit in units.items()
    }


def _surroundings(
    around: Mapping[str, Sequence[str]], pushed: Mapping[str, Mapping[str, int]]
) -> dict[str, tuple[str, ...]]:
    found = {x: tuple(u for u in inputs if x in pushed[u]) for x, inputs in around.items()}
    return {x: inputs for x, inputs in found.items() if inputs}


def _relative(
    around: Mapping[str, Sequence[str]],
    pushed: Mapping[str, Mapping[str, int]],
    states: Sequence[str],
    speeds: Mapping[str, str],
) -> dict[str, tuple[str, ...]]:
    """For each state, the differences of it or its integral and an input that acts on it."""
    found: dict[str, tuple[str, ...]] = {}
    for state in states:
        own = [
            difference(other, u)
            for other in states
            for u in around[other]
            if state in pushed[u] and state in (other, speeds.get(other))
        ]
        if own:
            found[state] = tuple(own)
    return found


def _feeds(
    trajectories: Sequence[LinearisedTrajectory], description: ModelDescription
) -> dict[str, tuple[str, ...]]:
    """The inputs that act on each output directly and not through states.

    With linearised trajectories, these are the inputs with an entry in D. In co-simulation, they
    are the declared dependencies of the output. Where these are not declared, all inputs count if
    the model has no states.
    """
    driven = trajectories[0].driven
    exchange = any(offer.interface == "model_exchange" for offer in description.offers)
    anything = driven if exchange and not description.states else ()
    declared = {d.name: d.on for d in description.dependencies if d.role == "output"}
    acting = {y: set(anything if on is None else on) for y, on in declared.items()}
    linear = [each.linear for each in trajectories if each.linear is not None]
    if linear:
        acting = defaultdict(set)
    for each in linear:
        for i, j in np.argwhere(np.abs(each.D).max(axis=0) > 0.0).tolist():
            acting[each.output_names[i]].add(each.input_names[j])
    return {y: tuple(u for u in driven if u in inputs) for y, inputs in acting.items()}


def _pushed(
    trajectories: Sequence[LinearisedTrajectory], states: Collection[str]
) -> dict[str, dict[str, int]]:
    """The states whose derivatives each input acts on, with the sign of its action."""
    found: dict[str, dict[str, int]] = {}
    for linear in (each.linear for each in trajectories if each.linear is not None):
        rates = np.abs(linear.derivatives).max(axis=0)
        sizes = np.abs(linear.effective_inputs).max(axis=0)
        acts = np.abs(linear.B).max(axis=0) * sizes > ACTS * rates[:, None]
        ways = (linear.B > 0.0).all(axis=0).astype(int) - (linear.B < 0.0).all(axis=0)
        for i, j in np.argwhere(acts).tolist():
            state, way = linear.state_names[i], int(ways[i, j])
            own = found.setdefault(linear.input_names[j], {})
            if state in states:
                own[state] = way if own.get(state, way) == way else 0
    return found


def variables_of(
    form: EffectForm,
    site: EffectSite,
    arguments: OpenArguments,
    leading: Collection[str] | None = None,
) -> list[tuple[str, ...]]:
    """Return the variables that a form at a site may have, from all or only leading arguments.

    Forms of time alone, or of the signal at the site alone, are tried at every site except state
    derivatives, of which a large model has many: there, only where `TIME` is leading.
    """
    if form.variables == 0:
        left_out = leading is not None and site.kind == "derivative" and TIME not in leading
        return [] if left_out else [()]
    if FormCondition.AROUND in form.when:
        pairs = arguments.around(site)
        return [p for p in pairs if leading is None or difference(*p) in leading]
    if FormCondition.EXCHANGE in form.when:
        own = difference(*site.targets)
        alike = own in arguments.between_states and (leading is None or own in leading)
        return [(own, other) for other in arguments.carriers(site)] if alike else []
    names = arguments.at(site) if leading is None else [n for n in leading if n != TIME]
    if leading is None and form.law not in FIRST_OF_READ and site.kind in ("parameter", "input"):
        names = [name for name in names if name not in arguments.read]
    if form.variables == 1:
        return [(name,) for name in names if arguments.takes(form, site, name)]
    if FormCondition.OWN in form.when:
        others = arguments.beside(site, names)
        return [(own, other) for own in arguments.pushed_by(site) for other in others]
    if FormCondition.FEEDS in form.when:
        names = [name for name in names if arguments.takes(form, site, name)]
    order = arguments.at(site).index
    return list(itertools.combinations(sorted(arguments.single(names), key=order), 2))


def open_places(
    sites: Sequence[EffectSite],
    arguments: OpenArguments,
    trajectories: Sequence[LinearisedTrajectory],
) -> list[CandidatePlace]:
    """List the places at these sites that make physical sense in a model of many states.

    A force between two states is tried only where one of them already acts on the other. Its
    argument is their difference, the first state, or a state that acts on both. A function of the
    difference of two states is tried at a derivative only where both states already act on it.
    """
    linear = [each.linear for each in trajectories if each.linear is not None]
    sizes = np.max([each.A.largest() for each in linear], axis=0)
    acts = sizes > ACTS * sizes.max(axis=1, keepdims=True, initial=0.0)
    index = {name: i for i, name in enumerate(arguments.states)}
    places = []
    for site in sites:
        names = arguments.at(site) if site.kind != "pair" else _between(site, index, acts)
        if site.kind == "derivative":
            row = acts[index[site.target]]
            pairs = arguments.between_states
            names = [n for n in names if all(row[index[x]] for x in pairs.get(n, ()))] + [TIME]
        places += [CandidatePlace(site, name) for name in names]
    return places


def _between(site: EffectSite, index: Mapping[str, int], acts: np.ndarray) -> list[str]:
    """The arguments at a pair of states; none where neither state acts on the other."""
    first, second = site.targets
    i, j = index[first], index[second]
    if not (acts[i, j] or acts[j, i]):
        return []
    both = [name for name, k in index.items() if k not in (i, j) and acts[i, k] and acts[j, k]]
    return [first, *([difference(first, second)] if i < j else []), *both]


def count_candidates(
    places: Sequence[CandidatePlace],
    forms: Mapping[EffectSite, Sequence[EffectForm]],
    arguments: OpenArguments,
) -> int:
    """Return how many candidates have been considered if all of these places have been ranked.

    The free curve at a place stands for every function of its argument. Products are not counted:
    there are far more of them, and they are made only of leading arguments.
    """
    return sum(
        len(variables_of(form, site, arguments, names))
        for site, names in by_site(places).items()
        for form in forms[site]
        if form.variables < 2
    )
