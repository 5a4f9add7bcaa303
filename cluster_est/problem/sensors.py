"""Sensors whose scale or offset is the same in all experiments: an effect at an output.

Each experiment is simulated and compared separately, so a scale that is computed with its residuals
cannot be the same for all experiments. The coefficients of an effect can. They are two linear
unknowns with standard errors, and held-out experiments use the same values.
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
"""The coefficients of an ideal sensor."""
_EQUATIONS = {
    (True, True): "scale * s + offset",
    (True, False): "scale * s",
    (False, True): "s + offset",
}
_SITE = "output "


def shared_sensor(output: str, *, scale: bool = True, offset: bool = False) -> MadeEffect:
    """Return the effect of an output's sensor, and its coefficients as parameters.

    In a config, this is free_scale = "shared". If only some experiments share a scale, such as
    those with the same sensor, replace the parameters' `per` by "group:KEY".

    Parameters
    ----------
    output
        Output of the FMU. The measured values are compared with scale * output + offset.
    scale, offset
        Whether each of the two is unknown; at least one must be.

    Returns
    -------
    MadeEffect
        The effect "sensor_OUTPUT" and its parameters "sensor_OUTPUT.scale" and
        "sensor_OUTPUT.offset". Append both to those of a problem.
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
    """Return the outputs that have a shared scale or offset."""
    sites = [e.site for e in problem.effects if _is_sensor(e)]
    return frozenset(site.removeprefix(_SITE) for site in sites)


def _is_sensor(effect: Effect) -> bool:
    return effect.equation in _EQUATIONS.values() and effect.site.startswith(_SITE)


@dataclass(frozen=True)
class UnstartedSensor:
    """A sensor whose scale or offset has no start value from the user.

    Attributes
    ----------
    output
        The output that it measures.
    experiments
        Positions in the search space of the experiments with this sensor.
    scale, offset
        Indices of its unknowns; None if the value is not unknown, or has a start value.
    """

    output: str
    experiments: tuple[int, ...]
    scale: int | None
    offset: int | None

    @property
    def unknowns(self) -> tuple[int, ...]:
        """Indices of the sensor's unknowns."""
        return tuple(i for i in (self.scale, self.offset) if i is not None)


def unstarted_sensors(space: SearchSpace) -> tuple[UnstartedSensor, ...]:
    """Return the sensors of a space whose scale or offset starts at that of an ideal sensor."""
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
