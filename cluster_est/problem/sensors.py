"""Sensors whose scale or offset is the same in all experiments: an effect at an output.

What an experiment's residuals take the best scale for themselves cannot be one for all of them, for
each experiment is simulated and compared alone. As the coefficients of an effect it is: two linear
unknowns, with standard errors, that held-out experiments share.
"""

from __future__ import annotations

from dataclasses import dataclass

from cluster_est.problem.declared_effects import (
    DeclaredCoefficient,
    DeclaredEffect,
    MadeEffect,
    make_effect,
)
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace
from workers.messages import Effect

SCALE, OFFSET = "scale", "offset"
NEUTRAL = {SCALE: 1.0, OFFSET: 0.0}
"""The coefficients with which a sensor shows what it measures."""
_EQUATIONS = {
    (True, True): "scale * s + offset",
    (True, False): "scale * s",
    (False, True): "s + offset",
}
_SITE = "output "


def shared_sensor(output: str, *, scale: bool = True, offset: bool = False) -> MadeEffect:
    """Return the effect of an output's sensor, and its coefficients as parameters.

    A config asks for it by free_scale = "shared". For a scale that some experiments share, such as
    those with one sensor, replace the parameters' `per` by "group:KEY".

    Parameters
    ----------
    output
        Of the FMU; what is compared is scale times it, plus offset.
    scale, offset
        Which of the two are unknown; at least one.

    Returns
    -------
    MadeEffect
        "sensor_OUTPUT" and its parameters "sensor_OUTPUT.scale" and "sensor_OUTPUT.offset", to be
        appended to those of a problem.
    """
    wanted = {SCALE: scale, OFFSET: offset}
    return make_effect(
        DeclaredEffect(
            name=f"sensor_{output}",
            site=f"{_SITE}{output}",
            equation=_EQUATIONS[scale, offset],
            coefficients={
                name: DeclaredCoefficient(start=NEUTRAL[name], neutral=NEUTRAL[name])
                for name, free in wanted.items()
                if free
            },
        )
    )


def sensor_outputs(problem: Problem) -> frozenset[str]:
    """Return the outputs that are seen through a sensor's scale or offset."""
    sites = [e.site for e in problem.effects if _is_sensor(e)]
    return frozenset(site.removeprefix(_SITE) for site in sites)


def _is_sensor(effect: Effect) -> bool:
    return effect.equation in _EQUATIONS.values() and effect.site.startswith(_SITE)


@dataclass(frozen=True)
class UnstartedSensor:
    """A sensor of a search space, of whose scale or offset no start is known.

    Attributes
    ----------
    output
        What it measures.
    experiments
        Positions in the space of the experiments that have it.
    scale, offset
        Indices of its unknowns; None where it has none, or it has a start of its own.
    """

    output: str
    experiments: tuple[int, ...]
    scale: int | None
    offset: int | None

    @property
    def unknowns(self) -> tuple[int, ...]:
        """Indices of those that it has."""
        return tuple(i for i in (self.scale, self.offset) if i is not None)


def unstarted_sensors(space: SearchSpace) -> tuple[UnstartedSensor, ...]:
    """Return the sensors of a space whose scale and offset start at those of a perfect one."""
    found = []
    for effect in space.problem.effects:
        if not _is_sensor(effect):
            continue
        scopes: dict[str, dict[str, int]] = {}
        for i, unknown in enumerate(space.unknowns):
            for name, neutral in NEUTRAL.items():
                own = unknown.parameter.name == f"{effect.name}.{name}"
                if own and unknown.start == neutral:
                    scopes.setdefault(unknown.scope, {})[name] = i
        for places in scopes.values():
            experiments = space.unknowns[next(iter(places.values()))].experiments
            output = effect.site.removeprefix(_SITE)
            found.append(
                UnstartedSensor(output, experiments, places.get(SCALE), places.get(OFFSET))
            )
    return tuple(found)
