"""A kiln whose heated plate warms a charge."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Role, Run, System, Values, make_run


def kiln_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Balances of heat of the plate and of the charge."""
    (plate, charge), (power, ambient) = x, u
    plate_capacity, charge_capacity, between, plate_loss, charge_loss = p
    passed = between * (plate - charge)
    return (
        (power - passed - plate_loss * (plate - ambient)) / plate_capacity,
        (passed - charge_loss * (charge - ambient)) / charge_capacity,
    )


def kiln_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure both temperatures."""
    return x[0], x[1]


def kiln_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Heat up, hold and let cool, in a hall whose temperature wanders."""

    def run(waveform: str, role: Role, power: Array, start: float) -> Run:
        ambient = 293.0 + 6.0 * wave.ramps(time, random, 900.0)
        return make_run(waveform, role, [power, ambient], {"T_plate": start, "T_charge": start})

    return [
        run("held steps", "train", 950.0 + 900.0 * wave.held(time, random, 300.0), 293.0),
        run("binary", "train", 800.0 + 700.0 * wave.binary(time, random, 200.0), 293.0),
        run("ramps", "train", 1000.0 + 950.0 * wave.ramps(time, random, 400.0), 400.0),
        run("pulses", "train", 500.0 + 480.0 * wave.binary(time, random, 350.0), 600.0),
        run("triangle", "test", 900.0 + 850.0 * wave.triangle(time, 1700.0), 293.0),
        run("noise", "test", 900.0 + 450.0 * wave.noise(time, random, 1.5e-3), 350.0),
    ]


KILN = System(
    name="kiln",
    interface="model_exchange",
    split="tune",
    states=("T_plate", "T_charge"),
    inputs=("power", "T_ambient"),
    outputs=("plate", "charge"),
    parameters={
        "C_plate": 400.0,
        "C_charge": 900.0,
        "G_between": 6.0,
        "G_plate": 2.5,
        "G_charge": 1.2,
    },
    rates=kiln_rates,
    readings=kiln_readings,
    interval=10.0,
    samples=400,
    excitation=kiln_runs,
    drives=(("power", "T_plate"),),
)
