"""Errors at the first sample: experiments that begin elsewhere than the model does.

A wrong initial state decays, or stays as an offset; either way it looks like something that the
model lacks, and no parameter removes it. At the first sample it is alone with the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.results.output_errors import Simulation, output_residuals
from cluster_est.toml import dotted
from workers.fmu.description import ModelDescription
from workers.messages import Experiment, FloatArray, Output

INITIAL_ERROR_OVER_NOISE = 10.0
"""Times the noise that an error at the first sample must reach."""
OUTSTANDING = 1.5
"""Times the error of the later half of the record that it must reach, once a model is fitted: what
stays is an offset. A swing that began elsewhere is 1.4 times its own root mean square."""
INITIAL_ERROR_OVER_SPREAD = 0.2
"""Share of the standard deviation of what was measured that it must reach, before the fit."""
MOST_NAMED_STATES = 3
"""States that a sentence names."""


@dataclass(frozen=True)
class InitialError:
    """An output that is far from the measurement at its first sample.

    Attributes
    ----------
    output, unit
        Its name and unit.
    distance
        The largest error at a first sample, in that unit.
    over_noise
        The largest error at a first sample, over the noise.
    found, count
        In how many experiments, of how many whose initial state is not estimated.
    """

    output: str
    unit: str
    distance: float
    over_noise: float
    found: int
    count: int

    @property
    def sentence(self) -> str:
        """Say how far off it is, and where."""
        size = f"{self.distance:.3g} {self.unit}".strip()
        several = "experiments begin" if self.count > 1 else "experiment begins"
        where = f"{self.found} of {self.count} {several}"
        return (
            f"{where} in a different state from the model: at the first sample, {self.output} is "
            f"off by up to {size}, {self.over_noise:.3g} times its noise"
        )


def initial_errors(
    problem: Problem, simulations: Sequence[Simulation], *, fitted: bool
) -> tuple[InitialError, ...]:
    """Find outputs that are off at the first sample in at least half of the experiments.

    An experiment whose initial state is estimated is left out.

    Parameters
    ----------
    simulations
        Of the problem's experiments, with trajectories.
    fitted
        They are at the estimates of a fit: what is left at the first sample must stand out.
    """
    if not simulations:
        return ()
    description = problem.describe()
    space = make_space(problem, tuple(range(len(problem.experiments))))
    offs: dict[str, list[tuple[float, float]]] = {}
    for each in simulations:
        if estimates_start(space, each.experiment, description):
            continue
        experiment = problem.experiments[each.experiment]
        for output in experiment.outputs:
            residuals = None if output.ordinal else output_residuals(output, each.outcome)
            if residuals is not None and _begins(experiment, output):
                offs.setdefault(output.variable, []).append(
                    _off(output, residuals * output.sigmas, fitted=fitted)
                )
    found = []
    for name, sizes in offs.items():
        far = [size for size in sizes if size[0] > 0.0]
        if far and 2 * len(far) >= len(sizes):
            distance, over_noise = max(far)
            unit = description.variables[name].unit
            found.append(InitialError(name, unit, distance, over_noise, len(far), len(sizes)))
    return tuple(sorted(found, key=lambda each: -each.over_noise))


def initial_notes(problem: Problem, simulations: Sequence[Simulation]) -> tuple[str, ...]:
    """Say where experiments begin elsewhere than a fitted model does, and what to do about it."""
    found = initial_errors(problem, simulations, fitted=True)
    if not found:
        return ()
    return (f"{found[0].sentence}, but later errors are smaller: {free_start_advice(problem)}",)


def free_start_advice(problem: Problem) -> str:
    """Say which keys give the initial states of the experiments, or let a fit find them."""
    description = problem.describe()
    taken = {p.target for p in problem.parameters if p.per != "gap"}
    states = [
        name
        for name in description.states
        if description.variables[name].settable and name not in taken
    ]
    named = states[:MOST_NAMED_STATES] or ["STATE"]
    starts = [description.variables[n].start if n in states else None for n in named]
    keys = ", ".join(
        f"{dotted('parameters', name)} = {{ start = {'NUMBER' if start is None else f'{start:g}'}, "
        'per = "experiment" }'
        for name, start in zip(named, starts, strict=True)
    )
    more = (
        f" and the same for the other {len(states) - len(named)} states"
        if len(states) > len(named)
        else ""
    )
    first = named[0]
    return (
        f"estimate the initial states, {keys}{more}; or give their measured values, "
        f"{dotted('values', first)} = NUMBER"
    )


def estimates_start(space: SearchSpace, experiment: int, description: ModelDescription) -> bool:
    """Return True if an unknown of an experiment is a start value, or its own.

    Parameters
    ----------
    space
        Of all experiments.
    """
    for unknown in space.unknowns:
        start = is_start_value(unknown.parameter, description)
        if experiment in unknown.experiments and (start or unknown.parameter.per):
            return True
    return False


def is_start_value(parameter: Parameter, description: ModelDescription) -> bool:
    """Return True if what is estimated is where a variable of the model begins."""
    found = description.variables.get(parameter.target)
    return found is not None and found.causality not in ("parameter", "input")


def noise_of_samples(values: FloatArray) -> float:
    """Return the noise of a signal by its second differences; 0 for one that is too short."""
    if len(values) < 4:
        return 0.0
    return float(1.4826 * np.median(np.abs(np.diff(values, 2))) / np.sqrt(6.0))


def _begins(experiment: Experiment, output: Output) -> bool:
    """Return True if an output is measured where its experiment starts, or one sample later."""
    if len(output.times) < 4:
        return False
    step = float(np.median(np.diff(output.times)))
    return bool(output.times[0] - experiment.start <= 1.5 * step)


def _off(output: Output, errors: FloatArray, *, fitted: bool) -> tuple[float, float]:
    """Return the error of a first sample, and its ratio to the noise; zeros if it is no error."""
    noise = float(output.sigmas[0]) if output.has_sigma else noise_of_samples(output.values)
    first = abs(float(errors[0]))
    later = float(np.sqrt(np.mean(errors[len(errors) // 2 :] ** 2)))
    least = (
        OUTSTANDING * later if fitted else INITIAL_ERROR_OVER_SPREAD * float(np.std(output.values))
    )
    if not first > max(INITIAL_ERROR_OVER_NOISE * noise, least):
        return 0.0, 0.0
    return first, first / noise if noise > 0.0 else np.inf
