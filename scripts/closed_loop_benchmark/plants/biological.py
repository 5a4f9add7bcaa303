"""A drug in the body, and microbes in a chemostat."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Role, Run, System, Values, make_run


def body_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Balances of three compartments with linear exchange."""
    (gut, central, tissue), (oral, infusion) = x, u
    absorption, elimination, outward, inward, _, _ = p
    return (
        oral - absorption * gut,
        infusion + absorption * gut - (elimination + outward) * central + inward * tissue,
        outward * central - inward * tissue,
    )


def body_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the concentrations in plasma and tissue."""
    return x[1] / p[4], x[2] / p[5]


def body_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Give meals of the drug, infusions, and both."""
    none = dict.fromkeys(("gut", "central", "tissue"), 0.0)

    def run(waveform: str, role: Role, oral: Array, infusion: Array) -> Run:
        return make_run(waveform, role, [oral, infusion], none)

    def doses(size: float, hold: float) -> Array:
        return np.asarray(size * np.maximum(wave.held(time, random, hold) - 0.2, 0.0))

    nothing = np.zeros_like(time)
    slow = 0.006 + 0.006 * wave.ramps(time, random, 14400.0)
    return [
        run("meals", "train", doses(0.06, 3600.0), nothing),
        run("infusions", "train", nothing, 0.01 + 0.01 * wave.binary(time, random, 10800.0)),
        run("both", "train", doses(0.04, 7200.0), doses(0.03, 9000.0)),
        run("slow infusion", "train", doses(0.03, 5400.0), slow),
        run("large meals", "test", doses(0.07, 5400.0), nothing),
        run("mixed", "test", doses(0.03, 3600.0), doses(0.02, 7200.0)),
    ]


PHARMACOKINETICS = System(
    name="pharmacokinetics",
    interface="model_exchange",
    split="tune",
    states=("gut", "central", "tissue"),
    inputs=("oral", "infusion"),
    outputs=("plasma_level", "tissue_level"),
    parameters={
        "k_a": 3e-4,
        "k_e": 8e-5,
        "k_12": 1.4e-4,
        "k_21": 7e-5,
        "volume": 20.0,
        "tissue_volume": 40.0,
    },
    rates=body_rates,
    readings=body_readings,
    interval=360.0,
    samples=400,
    excitation=body_runs,
    drives=(("oral", "gut"), ("infusion", "central")),
)


def chemostat_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Balances of biomass and substrate, growth by Monod."""
    (biomass, substrate), (dilution, feed) = x, u
    fastest, half, gained = p
    growth = fastest * biomass * substrate / (half + substrate)
    return (
        growth - dilution * biomass,
        dilution * (feed - substrate) - growth / gained,
    )


def chemostat_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure biomass and substrate."""
    return x[0], x[1]


def chemostat_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Change the flow and the strength of the feed, at times near to washing out."""

    def run(waveform: str, role: Role, flow: Array, feed: Array, start: float) -> Run:
        inputs = [5.5e-5 + 4e-5 * flow, 8.0 + 4.0 * feed]
        return make_run(waveform, role, inputs, {"X": start, "S": 1.0})

    def steps(hold: float) -> Array:
        return wave.held(time, random, hold)

    return [
        run("held steps", "train", steps(9000.0), steps(14400.0), 3.0),
        run("binary", "train", 0.9 * wave.binary(time, random, 10800.0), 0.6 * steps(9000.0), 1.0),
        run("ramps", "train", wave.ramps(time, random, 14400.0), steps(18000.0), 4.0),
        run("strong feed", "train", 0.8 * steps(12000.0), 0.7 + 0.3 * steps(16000.0), 2.0),
        run("triangle", "test", wave.triangle(time, 40000.0), 0.5 * steps(12000.0), 3.0),
        run("noise", "test", 0.6 * wave.noise(time, random, 5e-5), steps(15000.0), 2.0),
    ]


CHEMOSTAT = System(
    name="chemostat",
    interface="model_exchange",
    split="report",
    states=("X", "S"),
    inputs=("D", "S_in"),
    outputs=("biomass", "substrate"),
    parameters={"mu_max": 1.25e-4, "K_s": 0.4, "yield": 0.5},
    rates=chemostat_rates,
    readings=chemostat_readings,
    interval=360.0,
    samples=400,
    excitation=chemostat_runs,
)
