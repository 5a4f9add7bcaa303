"""Places: sites with an argument, and how many candidates there are at all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cluster_est.closed_loop.candidates.arguments import ACTS, TIME, CandidatePlace, OpenArguments
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from workers.effects.forms import EffectForm, FormCondition
from workers.effects.site import EffectSite, difference


def open_places(
    sites: Sequence[EffectSite],
    arguments: OpenArguments,
    trajectories: Sequence[LinearisedTrajectory],
) -> list[CandidatePlace]:
    """List the places at these sites that make physical sense in a model of many states.

    A force between two states is looked for where one of them acts on the other already, as a
    function of their difference, of the first of them, or of a state that acts on both.

    Parameters
    ----------
    sites
        In model exchange.
    arguments
        What the data offer.
    trajectories
        Of the training experiments, with linearisations.
    """
    acts = _acting(trajectories)
    index = {name: i for i, name in enumerate(arguments.states)}
    places = []
    for site in sites:
        names = arguments.at(site) if site.kind != "pair" else _between(site, index, acts)
        names = [*names, TIME] if site.kind == "derivative" else names
        places += [CandidatePlace(site, name) for name in names]
    return places


def _between(site: EffectSite, index: Mapping[str, int], acts: np.ndarray) -> list[str]:
    """The arguments at a pair of states; none where neither acts on the other."""
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
    """Return how many candidates have been looked at if all of these places have been.

    A free curve at a place stands for every function of its argument; products, of which there are
    far more, are made of leading arguments alone.
    """
    total = 0
    sites = dict.fromkeys(place.site for place in places)
    for site in sites:
        if site.kind not in ("derivative", "pair"):
            total += sum(form.variables == 0 for form in forms[site])
    for place in places:
        own = forms[place.site]
        if place.argument == TIME:
            total += sum(form.variables == 0 for form in own)
        else:
            total += sum(
                form.variables == 1 and arguments.takes(form, place.site, place.argument)
                for form in own
            )
    return total


def count_variables(form: EffectForm, site: EffectSite, arguments: OpenArguments) -> int:
    """Return of how many variables a form at a site may be a function, without a list of them."""
    if form.variables == 0:
        return 1
    if FormCondition.AROUND in form.when:
        return len(arguments.around(site))
    n = len(arguments.states)
    if site.kind == "pair":
        if FormCondition.FIRST in form.when:
            return 1
        first, second = (arguments.states.index(name) for name in site.targets)
        if form.free and first > second:
            return 0
        return n - 2 + (arguments.differences if first < second else 0)
    names = arguments.at(site)
    if form.variables == 2 and FormCondition.OWN in form.when:
        return len(arguments.pushed_by(site)) * len(arguments.beside(site, names))
    if form.variables == 2:
        if FormCondition.FEEDS in form.when:
            names = [name for name in names if arguments.takes(form, site, name)]
        single = len(arguments.single(names))
        return single * (single - 1) // 2
    return sum(arguments.takes(form, site, name) for name in names)


def _acting(trajectories: Sequence[LinearisedTrajectory]) -> np.ndarray:
    """(x, x) booleans: whether the second state acts on the first, anywhere along the data."""
    linear = [each.linear for each in trajectories if each.linear is not None]
    sizes = np.max([each.A.largest() for each in linear], axis=0)
    return np.asarray(sizes > ACTS * sizes.max(axis=1, keepdims=True, initial=0.0))
