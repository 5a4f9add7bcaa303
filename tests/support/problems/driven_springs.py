"""Springs on which a function of time and of the declared force acts, made by the plain model."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from support.truth.systems_with_missing_effects import measured, missing_effect_problem

import cluster_est as ce

SPRING = missing_effect_problem("mass_spring_damper", signals=())
NOISE = 0.002
MASS = 1.2
RESONANCE = np.sqrt(30.0 / MASS)
"""Of the mass on its spring, in rad/s: its damping ratio is 0.05."""
LARGEST = max(float(np.abs(run.inputs[0].values).max()) for run in SPRING.experiments)

Force = Callable[[np.ndarray, np.ndarray], np.ndarray]


def driven_by(*forces: Force) -> ce.Problem:
    """With a force for each run."""
    runs = []
    for run, force in zip(SPRING.experiments, forces, strict=True):
        (given,) = run.inputs
        acting = replace(given, values=force(given.times, given.values))
        runs.append(replace(run, inputs=(acting,)))
    made = measured(replace(SPRING, experiments=tuple(runs)), NOISE)
    runs = [
        replace(run, inputs=own.inputs, outputs=(replace(run.outputs[0], sigma=NOISE),))
        for run, own in zip(made.experiments, SPRING.experiments, strict=True)
    ]
    return replace(made, experiments=tuple(runs))


def dead(force: np.ndarray, width: float) -> np.ndarray:
    """What a dead zone leaves of it."""
    return np.sign(force) * np.maximum(np.abs(force) - width, 0.0)


def pushed_by_waves(frequency: float, ways: Sequence[float]) -> ce.Problem:
    return driven_by(
        *(lambda t, f, way=way: f + way * MASS * np.sin(frequency * t + 0.4) for way in ways)
    )
