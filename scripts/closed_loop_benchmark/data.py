"""The data of a case: what a method is given, and what is kept from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from closed_loop_benchmark.disturbances import push
from closed_loop_benchmark.scenarios import Noise, Scenario
from closed_loop_benchmark.system import Array, Role, Run, System
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import simulate


@dataclass(frozen=True)
class Experiment:
    """One run as a method is given it, and its truth.

    Attributes
    ----------
    waveform, role
        What drives it, and whether it is for training or held out.
    inputs, signals : (samples, inputs), (samples, signals)
        Linear between the samples; the signals are measured, but the FMU has no input for them.
    outputs : (samples, outputs)
        With noise.
    starts
        Initial states; those in `System.unknown_starts` are guesses.
    true_outputs, true_starts
        Not for the method.
    """

    waveform: str
    role: Role
    inputs: Array = field(repr=False)
    signals: Array = field(repr=False)
    outputs: Array = field(repr=False)
    starts: Mapping[str, float]
    true_outputs: Array = field(repr=False)
    true_starts: Mapping[str, float] = field(repr=False)


@dataclass(frozen=True)
class Data:
    """The data of a case.

    Attributes
    ----------
    scenario, system
        The case; not for the method but for the system's FMU, interface and names.
    times : (samples,)
        In seconds, of inputs and outputs alike.
    experiments
        Training runs first.
    sigma : (outputs,)
        Standard deviation of each output's noise.
    start_parameters
        Where an estimation begins.
    true_parameters
        Not for the method.
    """

    scenario: Scenario
    system: System
    times: Array = field(repr=False)
    experiments: tuple[Experiment, ...]
    sigma: Array
    start_parameters: Mapping[str, float]
    true_parameters: Mapping[str, float]


def make(scenario: Scenario) -> Data:
    """Simulate a case and add its noise.

    Parameters
    ----------
    scenario
        The case.

    Returns
    -------
    Data
        The same for the same scenario.
    """
    system = SYSTEMS[scenario.system]
    # Streams apart: no part changes when another draws more numbers.
    excited, pushed, measured, guessed = np.random.default_rng(scenario.seed).spawn(4)
    runs = system.excitation(system.times, excited)
    pushes = []
    if scenario.disturbance is not None:
        pushes = [push(scenario.disturbance, system, runs, pushed)]
    true = simulate(system, runs, scenario.effects, pushes)
    training = [y for run, y in zip(runs, true, strict=True) if run.role == "train"]
    sigma = scenario.noise.share * np.concatenate(training).std(axis=0)
    experiments = tuple(
        Experiment(
            run.waveform,
            run.role,
            run.inputs,
            run.signals,
            y + sigma * draw_noise(y.shape, scenario.noise, measured),
            guess_starts(system, run, guessed),
            y,
            run.starts,
        )
        for run, y in zip(runs, true, strict=True)
    )
    parameters = {
        name: value * (1.0 + system.spread(name) * guessed.uniform(-1.0, 1.0))
        for name, value in system.parameters.items()
    }
    return Data(
        scenario, system, system.times, experiments, sigma, parameters, dict(system.parameters)
    )


def draw_noise(shape: tuple[int, ...], noise: Noise, random: np.random.Generator) -> Array:
    """Draw noise of unit variance, white or AR(1) in time, but for its outliers."""
    wave, rho = random.normal(size=shape), noise.correlation
    for n in range(1, len(wave)):
        wave[n] = rho * wave[n - 1] + np.sqrt(1.0 - rho**2) * wave[n]
    if noise.outliers > 0.0:
        off = random.choice([-1.0, 1.0], shape) * random.uniform(8.0, 20.0, shape)
        wave += np.where(random.uniform(size=shape) < noise.outliers, off, 0.0)
    return wave


def guess_starts(system: System, run: Run, random: np.random.Generator) -> dict[str, float]:
    """Return the initial states, the unknown ones wrong by some percent."""
    wrong = {
        state: run.starts[state] * (1.0 + system.start_error * random.uniform(-1.0, 1.0))
        for state in system.unknown_starts
    }
    return {**run.starts, **wrong}
