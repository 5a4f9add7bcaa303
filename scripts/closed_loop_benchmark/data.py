"""The data of a case: the input of a method, also as a problem of cluster_est, and the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from closed_loop_benchmark.scenarios import Noise, Scenario, push
from closed_loop_benchmark.system import Array, Role, Run, System
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import Push, refine, simulate
from cluster_est import Input, Model, Output, Parameter, Problem, Solver
from cluster_est.problem.held_out import HELD_OUT_SUFFIX
from workers.messages import Experiment as MeasuredRun

PLACES = 8
"""Possible positions of a sample with jitter in an interval between two samples."""


@dataclass(frozen=True)
class Sampling:
    """Sampling of the runs of a case.

    Attributes
    ----------
    rate
        Number of samples for each of the system's own. The noise is multiplied by its root, so that
        the information of all samples together is the same.
    jitter
        Largest error of a sample's time, relative to the interval.
    """

    rate: int = 1
    jitter: float = 0.0

    @property
    def pieces(self) -> int:
        """Number of simulation intervals in one of the system's own."""
        return self.rate * (PLACES if self.jitter > 0.0 else 1)

    def finer(self, system: System) -> System:
        """Return a system that is sampled at all possible positions of samples."""
        return replace(
            system,
            interval=system.interval / self.pieces,
            samples=(system.samples - 1) * self.pieces + 1,
            substeps=max(system.substeps // self.pieces, 1),
        )

    def chosen(self, fine: System, random: np.random.Generator) -> Array:
        """Return the positions of the samples."""
        every = self.pieces // self.rate
        at = np.arange(0, fine.samples, every)
        off = np.rint(every * self.jitter * random.uniform(-1.0, 1.0, len(at))).astype(int)
        return np.asarray(np.clip(at + off, 0, fine.samples - 1))

    def noise(self, noise: Noise) -> Noise:
        """Return the noise of a sample."""
        return replace(
            noise,
            share=noise.share * np.sqrt(self.rate),
            correlation=noise.correlation ** (1.0 / self.rate),
        )


OWN = Sampling()
"""The system's own sampling."""


@dataclass(frozen=True)
class Experiment:
    """One run with the data for a method, and its truth.

    Attributes
    ----------
    waveform, role
        Its excitation, and whether it is for training or held out.
    inputs, signals : (driven, inputs), (driven, signals)
        Linear between the samples; the signals are measured but not inputs of the FMU.
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
        The case. The method may know only the system's FMU, interface and names.
    times : (samples,)
        Times of outputs in seconds.
    driven : (driven,)
        Times of inputs and signals.
    experiments
        Training runs first.
    sigma : (outputs,)
        Standard deviation of each output's noise.
    start_parameters
        Start values of an estimation.
    true_parameters
        Not for the method.
    """

    scenario: Scenario
    system: System
    times: Array = field(repr=False)
    driven: Array = field(repr=False)
    experiments: tuple[Experiment, ...]
    sigma: Array
    start_parameters: Mapping[str, float]
    true_parameters: Mapping[str, float]


def make(scenario: Scenario, sampling: Sampling = OWN, system: System | None = None) -> Data:
    """Simulate a case and add its noise.

    Parameters
    ----------
    scenario
        The case.
    sampling
        Sampling of its outputs; the excitation does not depend on it.
    system
        A system with other runs than the benchmark's.

    Returns
    -------
    Data
        The same for the same scenario and sampling.
    """
    system = system or SYSTEMS[scenario.system]
    # Separate streams, so that no part depends on the numbers drawn by another.
    excited, pushed, measured, guessed, jittered = np.random.default_rng(scenario.seed).spawn(5)
    runs = system.excitation(system.times, excited)
    pushes = []
    if scenario.disturbance is not None:
        pushes = [push(scenario.disturbance, system, runs, pushed)]
    fine, pieces = sampling.finer(system), sampling.pieces
    runs = [
        replace(run, inputs=refine(run.inputs, pieces), signals=refine(run.signals, pieces))
        for run in runs
    ]
    pushes = [Push(each.state, refine(each.signal, pieces)) for each in pushes]
    at = sampling.chosen(fine, jittered)
    true = [y[at] for y in simulate(fine, runs, scenario.effects, pushes)]
    training = [y for run, y in zip(runs, true, strict=True) if run.role == "train"]
    noise = sampling.noise(scenario.noise)
    sigma = noise.share * np.concatenate(training).std(axis=0)
    every = slice(None, None, pieces // sampling.rate)
    experiments = tuple(
        Experiment(
            run.waveform,
            run.role,
            run.inputs[every],
            run.signals[every],
            y + sigma * draw_noise(y.shape, noise, measured),
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
        scenario,
        system,
        fine.times[at],
        fine.times[every],
        experiments,
        sigma,
        parameters,
        dict(system.parameters),
    )


def draw_noise(shape: tuple[int, ...], noise: Noise, random: np.random.Generator) -> Array:
    """Draw noise of unit variance, apart from outliers, white or AR(1) in time."""
    wave, rho = random.normal(size=shape), noise.correlation
    for n in range(1, len(wave)):
        wave[n] = rho * wave[n - 1] + np.sqrt(1.0 - rho**2) * wave[n]
    if noise.outliers > 0.0:
        off = random.choice([-1.0, 1.0], shape) * random.uniform(8.0, 20.0, shape)
        wave += np.where(random.uniform(size=shape) < noise.outliers, off, 0.0)
    return wave


def guess_starts(system: System, run: Run, random: np.random.Generator) -> dict[str, float]:
    """Return the initial states, with errors of some percent in the unknown ones."""
    wrong = {
        state: run.starts[state] * (1.0 + system.start_error * random.uniform(-1.0, 1.0))
        for state in system.unknown_starts
    }
    return {**run.starts, **wrong}


MODELS = Path(__file__).resolve().parents[2] / "configs" / "models"
WIDTH = 4.0
"""Ratio of a parameter's bounds to its start value, upwards and downwards."""


def make_problem(data: Data, archive: bytes | None = None) -> Problem:
    """Return the problem that a method is given.

    Parameters
    ----------
    data
        The data of a case.
    archive
        The FMU; by default that of the example models.

    Returns
    -------
    Problem
        With the FMU, and without any effect.
    """
    system = data.system
    parameters = [_parameter(name, value) for name, value in data.start_parameters.items()]
    parameters += [_start(data, state) for state in system.unknown_starts]
    model = Model(
        name=system.fmu,
        archive=archive or _read(system.fmu),
        interface=system.interface,
        solver=_solver(system),
        parameters=tuple(p.target for p in parameters),
    )
    runs = tuple(_run(data, n) for n in range(len(data.experiments)))
    return Problem(model=model, parameters=tuple(parameters), experiments=runs)


def run_name(number: int, run: Experiment) -> str:
    """Return the name of a run in the problem."""
    return f"{number + 1} {run.waveform}"


def run_of(data: Data, name: str) -> Experiment:
    """Return the run of an experiment of the problem, or of its held-out part."""
    record = name.removesuffix(HELD_OUT_SUFFIX)
    return next(run for n, run in enumerate(data.experiments) if run_name(n, run) == record)


def start_label(state: str, number: int, run: Experiment) -> str:
    """Return the label of the unknown initial state of a run in an estimate."""
    return f"{state}_start[{run_name(number, run)}]"


@cache
def _read(file: str) -> bytes:
    return (MODELS / file).read_bytes()


def _solver(system: System) -> Solver:
    if system.interface == "co_simulation":
        return Solver("fmu")
    return Solver("dormand_prince", rtol=1e-7)


def _parameter(name: str, start: float) -> Parameter:
    low, high = sorted((start / WIDTH, start * WIDTH))
    return Parameter(name, start, (low, high), "log" if start > 0.0 else "linear")


def _start(data: Data, state: str) -> Parameter:
    """Return an unknown initial state with one start for all runs, and bounds for each guess."""
    guesses = np.array([run.starts[state] for run in data.experiments])
    room = 0.5 * np.abs(guesses)
    return Parameter(
        name=f"{state}_start",
        start=float(guesses.mean()),
        bounds=(float((guesses - room).min()), float((guesses + room).max())),
        variable=state,
        per="experiment",
    )


def _run(data: Data, number: int) -> MeasuredRun:
    run, system, times = data.experiments[number], data.system, data.times
    driven = data.driven
    known = {s: v for s, v in run.starts.items() if s not in system.unknown_starts}
    outputs = tuple(
        Output(name, times, np.ascontiguousarray(column), float(sigma))
        for name, column, sigma in zip(system.outputs, run.outputs.T, data.sigma, strict=True)
    )
    return MeasuredRun(
        id=run_name(number, run),
        start=float(min(times[0], driven[0])),
        stop=float(max(times[-1], driven[-1])),
        inputs=_signals(system.inputs, driven, run.inputs),
        outputs=outputs,
        values=tuple({**system.constants, **known}.items()),
        role=run.role,
        signals=_signals(system.signals, driven, run.signals),
    )


def _signals(names: tuple[str, ...], times: Array, columns: Array) -> tuple[Input, ...]:
    pairs = zip(names, columns.T, strict=True)
    return tuple(Input(name, times, np.ascontiguousarray(column)) for name, column in pairs)
