"""A case of long records: a motor with an elastic belt and a load, recorded by a logger.

    from closed_loop_benchmark.long_records import motor

    problem, truth = motor(rows=20_000, records=6)

Each record is sampled at 1 kHz, whatever the time constants of the drive are. The model lacks dry
friction at the load.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.data import Data, Experiment, draw_noise, guess_starts, make_problem
from closed_loop_benchmark.effect import Effect
from closed_loop_benchmark.mechanical import belt_rates
from closed_loop_benchmark.scenarios import Noise
from closed_loop_benchmark.scenarios import scenario as scenario_of
from closed_loop_benchmark.system import Array, Run, System, Values, make_run, measured
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import simulate
from cluster_est import Problem

RATE = 1000.0
"""Rows per second."""
FRICTION = Effect("dry friction", "coulomb", "der(w_load)", (-6.0, 0.05), "w_load")
KNOWN = {"L": 6e-3}
"""The inductance, which is known from the data sheet of the motor."""
PARAMETERS = {
    "R": 1.1,
    "K": 0.055,
    "J_motor": 1.1e-3,
    "b_motor": 1e-4,
    "k_belt": 1.8,
    "d_belt": 2e-2,
    "J_load": 4.5e-3,
    "b_load": 4e-4,
}
NOISE = Noise(0.02)
DC_MOTOR_BELT = SYSTEMS["dc_motor_belt"]


def motor_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Rates of the drive; the known inductance comes after the unknown parameters."""
    return belt_rates(x, u, [p[0], p[8], *p[1:8]])


def motor_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Drive and brake, up to the resonance of the belt at 7 Hz."""
    rest = dict.fromkeys(DC_MOTOR_BELT.states, 0.0)
    none = np.zeros(len(time))
    brake = 0.05 * wave.held(time, random, 2.0)
    return [
        make_run("multisine", "train", [7.0 * wave.multisine(time, random, 0.1, 5.0), none], rest),
        make_run("held steps", "train", [9.0 * wave.held(time, random, 0.8), none], rest),
        make_run("binary", "train", [4.0 * wave.binary(time, random, 0.4), brake], rest),
        make_run("noise", "train", [6.0 * wave.noise(time, random, 1.0), brake[::-1]], rest),
        make_run("triangle", "test", [8.0 * wave.triangle(time, 1.7), none], rest),
        make_run("more steps", "test", [7.0 * wave.held(time, random, 0.6), brake], rest),
    ]


def motor_system(rows: int, unknown_starts: tuple[str, ...] = ()) -> System:
    """Return the drive with records of `rows` rows."""
    return replace(
        DC_MOTOR_BELT,
        parameters=PARAMETERS,
        constants=KNOWN,
        rates=motor_rates,
        outputs=("current", "speed"),
        readings=measured(0, 1),
        interval=1.0 / RATE,
        samples=rows,
        excitation=motor_runs,
        unknown_starts=unknown_starts,
        substeps=2,
    )


def motor(
    rows: int, records: int = 6, *, seed: int = 1, unknown_starts: tuple[str, ...] = ()
) -> tuple[Problem, float]:
    """Return the problem, and the true strength of the missing dry friction.

    Parameters
    ----------
    rows
        Number of rows of each record.
    records
        Number of records, at most six, of which the last two are held out.
    seed
        Seed of all random generators.
    unknown_starts
        States with unknown initial values other than zero.
    """
    system = motor_system(rows, unknown_starts)
    excited, measured, guessed = np.random.default_rng(seed).spawn(3)
    runs = system.excitation(system.times, excited)
    runs = [
        replace(run, starts={**run.starts, **dict.fromkeys(unknown_starts, 5.0)}) for run in runs
    ]
    runs = runs[:records]
    true = simulate(system, runs, [FRICTION])
    training = [y for run, y in zip(runs, true, strict=True) if run.role == "train"]
    sigma = NOISE.share * np.concatenate(training).std(axis=0)
    experiments = tuple(
        Experiment(
            run.waveform,
            run.role,
            run.inputs,
            run.signals,
            y + sigma * draw_noise(y.shape, NOISE, measured),
            guess_starts(system, run, guessed),
            y,
            run.starts,
        )
        for run, y in zip(runs, true, strict=True)
    )
    starts = {
        name: value * (1.0 + 0.25 * guessed.uniform(-1.0, 1.0))
        for name, value in system.parameters.items()
    }
    scenario = scenario_of(system.name, "single", "dry friction", NOISE, [FRICTION])
    data = Data(
        scenario,
        system,
        system.times,
        system.times,
        experiments,
        sigma,
        starts,
        dict(system.parameters),
    )
    return make_problem(data), FRICTION.numbers[0]
