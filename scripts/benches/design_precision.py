"""What the standard errors of D-optimal inputs come to, beside what was predicted of them.

So far there is one short record, so that the new experiment decides; the input alone is limited, as
its power is what is compared. Beside it stand multisines of equal power, and as large as the limits
allow. The systems (`only`) are those of the closed-loop benchmark, and so are the data.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from closed_loop_benchmark.data import Data, draw_noise, make, make_problem
from closed_loop_benchmark.scenarios import all_scenarios
from closed_loop_benchmark.system import Run
from closed_loop_benchmark.truth import simulate

import cluster_est as ce
from benches import Row
from cluster_est.experiment_design.design import design
from cluster_est.experiment_design.limits import ExperimentLimits, InputLimits, SignalLimits
from cluster_est.experiment_design.request import DesignSettings
from cluster_est.problem.problem import Problem
from workers.messages import Experiment

OPTIONS = {"only": ["mass_spring_damper", "dc_motor", "thermal_two_node"]}
WIDER = 0.25
CANDIDATES = 120


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each system."""
    for name in options.only:
        case = next(c for c in all_scenarios() if c.system == name and c.kind == "clean")
        data = make(replace(case, noise=replace(case.noise, correlation=0.0)))
        problem = make_problem(data)
        alone = replace(problem, experiments=(shortened(problem.experiments[0]),))
        result = ce.fit(alone, method=ce.LeastSquares(max_iterations=60))
        limits = limits_of(data, problem)
        signals = dict.fromkeys(data.system.outputs, SignalLimits(lower=-1e6, upper=1e6))
        settings = DesignSettings(criterion="d", candidates=CANDIDATES)
        found = design(result, limits.changed(signals=signals), settings=settings)
        came = errors_with(alone, measured(data, found.experiment, 1))
        ratios = [came[row.label] / row.std_error_after for row in found.precision]
        over = {}
        for kind in ("power", "limits"):
            sines = []
            for seed in range(5):
                wave = multisine(found.experiment, limits, np.random.default_rng(seed), kind)
                own = errors_with(alone, measured(data, wave, 3 + seed))
                sines.append([came[row.label] / own[row.label] for row in found.precision])
            over[kind] = float(np.exp(np.mean(np.log(np.median(np.array(sines), axis=0)))))
        yield {
            "system": name,
            "came over predicted, least": float(min(ratios)),
            "most": float(max(ratios)),
            "over a multisine of equal power": over["power"],
            "within the same limits": over["limits"],
        }


def limits_of(data: Data, problem: Problem) -> ExperimentLimits:
    """The inputs a quarter wider than they have been; as long and as dense as a record."""
    inputs = {}
    for place, name in enumerate(data.system.inputs):
        values = np.concatenate([run.inputs[:, place] for run in data.experiments])
        low, high = float(values.min()), float(values.max())
        room = WIDER * (high - low)
        inputs[name] = InputLimits(
            lower=low - room if low < 0.0 else max(low - room, 0.0), upper=high + room
        )
    times = problem.experiments[0].outputs[0].times
    step = float(times[1] - times[0])
    duration = float(times[-1] - times[0])
    return ExperimentLimits(inputs=inputs, duration=(duration, duration), sample_time=step)


def measured(data: Data, experiment: Experiment, stream: int) -> Experiment:
    """The experiment as it would be measured: from the benchmark's own equations, with noise."""
    first = data.experiments[0]
    known = {given.variable: given for given in experiment.inputs}
    inputs = np.column_stack([known[name].values for name in data.system.inputs])
    run = Run("designed", "train", inputs, dict(first.true_starts), first.signals)
    (true,) = simulate(data.system, [run], data.scenario.effects, [])
    random = np.random.default_rng([data.scenario.seed, stream])
    noisy = true + data.sigma * draw_noise(true.shape, data.scenario.noise, random)
    outputs = tuple(
        ce.Output(name, data.times, np.ascontiguousarray(column), float(sigma))
        for name, column, sigma in zip(data.system.outputs, noisy.T, data.sigma, strict=True)
    )
    return replace(experiment, id=f"next {stream}", outputs=outputs, bounds=())


def shortened(experiment: Experiment) -> Experiment:
    """The first fifth of a record."""
    stop = experiment.start + 0.2 * (experiment.stop - experiment.start)
    outputs = []
    for output in experiment.outputs:
        kept = output.times <= stop
        outputs.append(replace(output, times=output.times[kept], values=output.values[kept]))
    return replace(experiment, stop=stop, outputs=tuple(outputs))


def errors_with(problem: Problem, experiment: Experiment) -> dict[str, float]:
    """The standard errors of a fit with one experiment more, by label."""
    both = replace(problem, experiments=(*problem.experiments, experiment))
    result = ce.fit(both, method=ce.LeastSquares(max_iterations=60))
    return {estimate.label: estimate.std_error for estimate in result.estimates}


def multisine(
    experiment: Experiment, limits: ExperimentLimits, random: np.random.Generator, kind: str
) -> Experiment:
    """The same experiment, driven by a multisine of equal power, or one as large as limits allow.

    A flat spectrum of all harmonics of the record up to an eighth of the rate of the samples.
    """
    inputs = []
    for given in experiment.inputs:
        times = given.times - given.times[0]
        count = int(times[-1] / (8.0 * (times[1] - times[0])))
        frequencies = np.arange(1, count + 1) / times[-1]
        phases = random.uniform(0.0, 2.0 * np.pi, count)
        wave = np.sin(2.0 * np.pi * np.outer(times, frequencies) + phases).sum(axis=1)
        own = limits.inputs[given.variable]
        if kind == "power":
            values = given.values.mean() + (wave - wave.mean()) * given.values.std() / wave.std()
        else:
            values = own.lower + (own.upper - own.lower) * (wave - wave.min()) / np.ptp(wave)
        inputs.append(replace(given, values=values))
    return replace(experiment, inputs=tuple(inputs))
