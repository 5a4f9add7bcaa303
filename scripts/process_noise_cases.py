"""Springs and pendulums that lack an effect, pushed at random: cases for `bench_process_noise`.

The truth is integrated here: an exact Ornstein-Uhlenbeck process at steps of a twentieth of the
samples, and classic Runge-Kutta steps of the equations of motion between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import cluster_est as ce

Array = NDArray[np.float64]
Motion = Callable[[float, float, float, float], float]
"""Acceleration as a function of place, speed, known push and unknown one."""

FOLDER = Path(__file__).resolve().parent.parent / "configs" / "models"
FINE, SAMPLES, STEP = 20, 400, 0.02
TRAINING, HELD_OUT = 3, 1

NAMES = {
    "nothing": ((), ()),
    "coulomb": (("coulomb",), ("dahl", "stribeck", "asymmetric_coulomb", "power", "signed_root")),
    "cubic": (("cubic",), ("power", "hinge", "hinge_below")),
    "drag": (("quadratic",), ("power",)),
}
"""What may be missing: the forms that are its name, and those that are nearly the same function."""


@dataclass(frozen=True)
class PushedModel:
    """A model of place and speed that is pushed at random.

    Attributes
    ----------
    file, states, output, driven, truth
        Of the FMU: names of place and speed, of what is measured, of the known push, and its
        parameters' true values.
    starts, sigma, first
        Of the estimation, the noise of the sensor, and the place at the start.
    inertia
        Divides forces.
    restoring
        Force of place.
    strengths
        Of the effects that are missing, by name.
    pushes, lasting
        Standard deviations of the unknown push, and its time.
    """

    file: str
    states: tuple[str, str]
    output: str
    driven: str
    truth: dict[str, float]
    starts: dict[str, tuple[float, float, float]]
    sigma: float
    first: float
    inertia: float
    restoring: Callable[[float], float]
    damping: float
    strengths: dict[str, float]
    known: tuple[float, float]
    pushes: tuple[float, ...]
    lasting: float

    @property
    def sites(self) -> tuple[str, ...]:
        """Where a force may stand: it is the same at both."""
        return (f"der({self.states[1]})", f"input {self.driven}")


MODELS = {
    "spring": PushedModel(
        "mass_spring_damper.fmu", ("x", "v"), "y", "F", {"m": 1.2, "k": 30.0, "c": 0.6},
        {"m": (1.0, 0.1, 10.0), "k": (25.0, 1.0, 200.0), "c": (0.4, 0.0, 10.0)},
        sigma=0.01, first=0.1, inertia=1.2, restoring=lambda x: 30.0 * x, damping=0.6,
        strengths={"coulomb": 1.0, "cubic": 60.0, "drag": 0.8}, known=(3.0, 2.0),
        pushes=(0.4, 1.3, 2.6), lasting=0.4,
    ),
    "pendulum": PushedModel(
        "pendulum.fmu", ("angle", "speed"), "y", "torque", {"J": 0.1, "G": 2.0, "b": 0.04},
        {"J": (0.12, 0.01, 1.0), "G": (1.7, 0.1, 20.0), "b": (0.03, 0.0, 1.0)},
        sigma=0.01, first=0.3, inertia=0.1, restoring=lambda a: 2.0 * math.sin(a), damping=0.04,
        strengths={"coulomb": 0.15, "drag": 0.05}, known=(0.6, 0.4),
        pushes=(0.2,), lasting=0.3,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class NoiseCase:
    """One set of records of a model that lacks an effect, or nothing.

    Attributes
    ----------
    model, missing
        Names in `MODELS` and `NAMES`.
    push
        Standard deviation of the unknown push.
    seed
        Of its random numbers.
    """

    model: str
    missing: str
    push: float
    seed: int

    def problem(self) -> ce.Problem:
        """Return the declared model with its process noise, and the records."""
        made = MODELS[self.model]
        generator = np.random.default_rng(self.seed)
        times = np.asarray(STEP * np.arange(SAMPLES), np.float64)
        runs = []
        for i in range(TRAINING + HELD_OUT):
            known = made.known[0] * np.sin((3.0 + 0.6 * i) * times)
            known += made.known[1] * np.sign(np.sin(1.9 * times + i))
            seen = self._record(generator, known) + made.sigma * generator.normal(size=SAMPLES)
            runs.append(
                ce.Experiment(
                    f"r{i}",
                    0.0,
                    times[-1],
                    (ce.Input(made.driven, times, known, "hold"),),
                    (ce.Output(made.output, times, seen, sigma=made.sigma),),
                    ((made.states[0], made.first),),
                    role="train" if i < TRAINING else "test",
                )
            )
        parameters = [ce.Parameter(name, *start) for name, start in made.starts.items()]
        parameters.append(ce.Parameter("push.q", 1.0, 0.001, 100.0, "log"))
        parameters.append(ce.Parameter("push.tau", 0.2, 0.01, 10.0, "log"))
        return ce.Problem(
            ce.read_model(FOLDER / made.file, list(made.truth)),
            tuple(parameters),
            tuple(runs),
            effects=(ce.Effect("push", f"input {made.driven}", "coloured_noise"),),
        )

    def outcome(self, result: ce.LoopResult) -> str:
        """Return "right", "nearly", "wrong" or "none"."""
        if not result.effects:
            return "none"
        exact, near = NAMES[self.missing]
        sites = MODELS[self.model].sites
        here = [effect for effect in result.effects if effect.site in sites]
        if len(result.effects) > 1 or not here:
            return "wrong"
        forms = {effect.form for effect in here}
        return "right" if forms <= {*exact} else "nearly" if forms <= {*exact, *near} else "wrong"

    def _record(self, generator: np.random.Generator, known: Array) -> Array:
        """Places at the samples, with a push that is drawn."""
        made = MODELS[self.model]
        step = STEP / FINE
        kept = np.exp(-step / made.lasting)
        drawn = self.push * np.sqrt(1.0 - kept * kept)
        motion = self._motion()
        place, speed, push = made.first, 0.0, self.push * generator.normal()
        places = []
        for force in known.tolist():
            places.append(place)
            for _ in range(FINE):
                after = kept * push + drawn * generator.normal()
                place, speed = runge_kutta(motion, place, speed, force, (push, after), step)
                push = after
        return np.array(places)

    def _motion(self) -> Motion:
        """Return the acceleration with what is missing."""
        made = MODELS[self.model]
        size = made.strengths.get(self.missing, 0.0)

        def missing(place: float, speed: float) -> float:
            if self.missing == "coulomb":
                return size * float(np.tanh(speed / 0.01))
            if self.missing == "drag":
                return size * speed * abs(speed)
            return size * place**3

        def acceleration(place: float, speed: float, force: float, push: float) -> float:
            resisting = made.restoring(place) + made.damping * speed + missing(place, speed)
            return (force + push - resisting) / made.inertia

        return acceleration


def runge_kutta(
    motion: Motion,
    place: float,
    speed: float,
    force: float,
    pushes: tuple[float, float],
    step: float,
) -> tuple[float, float]:
    """One classic step; the unknown push goes in a straight line from one value to the other."""
    half = 0.5 * step
    middle = 0.5 * (pushes[0] + pushes[1])
    v1, a1 = speed, motion(place, speed, force, pushes[0])
    v2 = speed + half * a1
    a2 = motion(place + half * v1, v2, force, middle)
    v3 = speed + half * a2
    a3 = motion(place + half * v2, v3, force, middle)
    v4 = speed + step * a3
    a4 = motion(place + step * v3, v4, force, pushes[1])
    return (
        place + step * (v1 + 2.0 * v2 + 2.0 * v3 + v4) / 6.0,
        speed + step * (a1 + 2.0 * a2 + 2.0 * a3 + a4) / 6.0,
    )
