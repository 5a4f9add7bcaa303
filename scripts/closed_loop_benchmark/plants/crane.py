"""A gantry crane."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Role, Run, System, Values, make_run

GRAVITY = 9.81


def crane_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Newton's law for the trolley and, along the rope's normal, for the load."""
    (_, speed, angle, turning), (force,) = x, u
    trolley, load, rope, friction, damping = p
    sine, cosine = np.sin(angle), np.cos(angle)
    joint = damping * turning / rope
    driven = (
        force
        - friction * speed
        + load * rope * turning**2 * sine
        + load * GRAVITY * sine * cosine
        + joint * cosine
    )
    acceleration = driven / (trolley + load * sine**2)
    swing = -(acceleration * cosine + GRAVITY * sine + joint / load) / rope
    return speed, acceleration, turning, swing


def crane_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the position of the trolley and the angle of the rope."""
    return x[0], x[2]


def crane_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Drive to and fro, slowly and near the frequency of the swing, 0.6 Hz."""
    rest = dict.fromkeys(("x", "v", "phi", "w"), 0.0)

    def run(waveform: str, role: Role, force: Array, angle: float = 0.0) -> Run:
        # without a mean, or the trolley would leave the rail
        return make_run(waveform, role, [force - force.mean()], {**rest, "phi": angle})

    return [
        run("multisine", "train", 14.0 * wave.multisine(time, random, 0.1, 2.0)),
        run("held steps", "train", 16.0 * wave.held(time, random, 0.8)),
        run("binary", "train", 8.0 * wave.binary(time, random, 0.4), 0.25),
        run("noise", "train", 12.0 * wave.noise(time, random, 1.0)),
        run("triangle", "test", 14.0 * wave.triangle(time, 2.7), 0.25),
        run("chirp", "test", 12.0 * wave.chirp(time, 0.1, 2.0)),
    ]


GANTRY_CRANE = System(
    name="gantry_crane",
    interface="model_exchange",
    split="tune",
    states=("x", "v", "phi", "w"),
    inputs=("F",),
    outputs=("position", "angle"),
    parameters={
        "m_trolley": 6.0,
        "m_load": 2.0,
        "l_rope": 0.8,
        "b_trolley": 8.0,
        "d_pivot": 0.05,
    },
    rates=crane_rates,
    readings=crane_readings,
    interval=0.02,
    samples=500,
    excitation=crane_runs,
)
