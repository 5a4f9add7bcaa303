"""The closed loop under process noise: springs and pendulums that lack an effect, pushed at random.

The loop is closed on springs that lack an effect (`missing`), or nothing, under unknown pushes of
three strengths, and on a pendulum (`models`). The truth is integrated here: an exact
Ornstein-Uhlenbeck process at steps of a twentieth of the samples, and classic Runge-Kutta steps of
the equations of motion between them. A row has what was found, each time (`repetitions`).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

import cluster_est as ce
from benches import Row
from benches.common import MODELS as FOLDER
from benches.common import Array
from workers.messages import Role

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
    file, states, output, driven, parameters
        Of the FMU: names of place and speed, of what is measured, of the known push, and of its
        parameters.
    starts, first, sigma
        Of the estimation, the place at the start, and the noise of the sensor.
    inertia, restoring, damping
        What divides forces, and the forces of place and of speed.
    strengths
        Of the effects that are missing, by name.
    known, pushes, lasting
        Sizes of the known push, standard deviations of the unknown one, and its time.
    """

    file: str
    states: tuple[str, str]
    output: str
    driven: str
    parameters: tuple[str, ...]
    starts: dict[str, tuple[float, float, float]]
    first: float
    inertia: float
    restoring: Callable[[float], float]
    damping: float
    strengths: dict[str, float]
    known: tuple[float, float]
    pushes: tuple[float, ...]
    lasting: float
    sigma: float = 0.01


MODELS = {
    "spring": PushedModel(
        "mass_spring_damper.fmu", ("x", "v"), "y", "F", ("m", "k", "c"),
        {"m": (1.0, 0.1, 10.0), "k": (25.0, 1.0, 200.0), "c": (0.4, 0.0, 10.0)},
        first=0.1, inertia=1.2, restoring=lambda x: 30.0 * x, damping=0.6,
        strengths={"coulomb": 1.0, "cubic": 60.0, "drag": 0.8}, known=(3.0, 2.0),
        pushes=(0.4, 1.3, 2.6), lasting=0.4,
    ),
    "pendulum": PushedModel(
        "pendulum.fmu", ("angle", "speed"), "y", "torque", ("J", "G", "b"),
        {"J": (0.12, 0.01, 1.0), "G": (1.7, 0.1, 20.0), "b": (0.03, 0.0, 1.0)},
        first=0.3, inertia=0.1, restoring=lambda a: 2.0 * math.sin(a), damping=0.04,
        strengths={"coulomb": 0.15, "drag": 0.05}, known=(0.6, 0.4),
        pushes=(0.2,), lasting=0.3,
    ),
}  # fmt: skip
OPTIONS = {"repetitions": 12, "missing": list(NAMES), "models": list(MODELS)}


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each loop."""
    for name in options.models:
        for missing in options.missing:
            for size in MODELS[name].pushes:
                for seed in range(options.repetitions):
                    result = ce.close_loop(made_problem(MODELS[name], missing, size, seed))
                    named = [f"{e.form} {e.variables} at {e.site}" for e in result.effects]
                    noise = [f"{c.before:.3g} to {c.after:.3g}" for c in result.process_noise]
                    yield {
                        "model": name,
                        "push": size,
                        "missing": missing,
                        "seed": seed,
                        "outcome": outcome(MODELS[name], missing, result),
                        "verdict": str(result.verdict),
                        "named": "; ".join(named),
                        "noise": "; ".join(noise),
                    }


def made_problem(made: PushedModel, missing: str, push: float, seed: int) -> ce.Problem:
    """Return the declared model with its process noise, and the records."""
    generator = np.random.default_rng(seed)
    times = np.asarray(STEP * np.arange(SAMPLES), np.float64)
    runs = []
    for i in range(TRAINING + HELD_OUT):
        known = made.known[0] * np.sin((3.0 + 0.6 * i) * times)
        known += made.known[1] * np.sign(np.sin(1.9 * times + i))
        true = places(made, missing, push, generator, known)
        seen = true + made.sigma * generator.normal(size=SAMPLES)
        given = (ce.Input(made.driven, times, known, "hold"),)
        measured = (ce.Output(made.output, times, seen, sigma=made.sigma),)
        start = ((made.states[0], made.first),)
        role: Role = "train" if i < TRAINING else "test"
        runs.append(ce.Experiment(f"r{i}", 0.0, times[-1], given, measured, start, role=role))
    parameters = [
        ce.Parameter(name, first, (low, high)) for name, (first, low, high) in made.starts.items()
    ]
    parameters.append(ce.Parameter("push.q", 1.0, (0.001, 100.0), "log"))
    parameters.append(ce.Parameter("push.tau", 0.2, (0.01, 10.0), "log"))
    model = ce.read_model(FOLDER / made.file)
    effects = (ce.Effect("push", f"input {made.driven}", "coloured_noise"),)
    return ce.Problem(model, tuple(parameters), tuple(runs), effects=effects)


def outcome(made: PushedModel, missing: str, result: ce.LoopResult) -> str:
    """Return "right", "nearly", "wrong" or "none"; a force is the same at both sites."""
    if not result.effects:
        return "none"
    exact, near = NAMES[missing]
    sites = (f"der({made.states[1]})", f"input {made.driven}")
    here = [effect for effect in result.effects if effect.site in sites]
    if len(result.effects) > 1 or not here:
        return "wrong"
    forms = {effect.form for effect in here}
    return "right" if forms <= {*exact} else "nearly" if forms <= {*exact, *near} else "wrong"


def places(
    made: PushedModel, missing: str, size: float, generator: np.random.Generator, known: Array
) -> Array:
    """Places at the samples, with a push that is drawn; between two of its values it is linear."""
    h = STEP / FINE
    kept = np.exp(-h / made.lasting)
    drawn = size * np.sqrt(1.0 - kept * kept)
    strength = made.strengths.get(missing, 0.0)

    def resisting(place: float, speed: float) -> float:
        if missing == "coulomb":
            return strength * float(np.tanh(speed / 0.01))
        return strength * speed * abs(speed) if missing == "drag" else strength * place**3

    def motion(place: float, speed: float, force: float, push: float) -> float:
        held = made.restoring(place) + made.damping * speed + resisting(place, speed)
        return (force + push - held) / made.inertia

    place, speed, push = made.first, 0.0, size * generator.normal()
    found = []
    for force in known.tolist():
        found.append(place)
        for _ in range(FINE):
            after = kept * push + drawn * generator.normal()
            middle = 0.5 * (push + after)
            v1, a1 = speed, motion(place, speed, force, push)
            v2 = speed + 0.5 * h * a1
            a2 = motion(place + 0.5 * h * v1, v2, force, middle)
            v3 = speed + 0.5 * h * a2
            a3 = motion(place + 0.5 * h * v2, v3, force, middle)
            v4 = speed + h * a3
            a4 = motion(place + h * v3, v4, force, after)
            place += h * (v1 + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
            speed += h * (a1 + 2.0 * a2 + 2.0 * a3 + a4) / 6.0
            push = after
    return np.array(found)
