"""Errors at the first sample, which show that the initial state of an experiment is wrong.

The error of a wrong initial state decays or remains as an offset. It looks like a missing effect,
and no parameter removes it. At the first sample, the residual contains only this error and noise.
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
"""Least ratio of an error at the first sample to the noise."""
OUTSTANDING = 1.5
"""Least ratio of an error at the first sample to the error of the second half of the record, for a
fitted model. An error that remains is an offset. A sine is 1.4 times its own root mean square."""
INITIAL_ERROR_OVER_SPREAD = 0.2
"""Least ratio of an error at the first sample to the measured standard deviation, before a fit."""
MOST_NAMED_STATES = 3
"""Largest number of states that a sentence names."""


@dataclass(frozen=True)
class InitialError:
    """An output that is far from the measurement at its first sample.

    Attributes
    ----------
    output, unit
        Name and unit of the output.
    distance
        The largest error at a first sample, in this unit.
    over_noise
        The largest error at a first sample, over the noise.
    found, count
        Number of experiments with such an error, and of all whose initial state is not estimated.
    """

    output: str
    unit: str
    distance: float
    over_noise: float
    found: int
    count: int

    @property
    def sentence(self) -> str:
        """The size of the error, and the experiments, as a sentence."""
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
    """Find outputs with a large error at the first sample in at least half of the experiments.

    Experiments whose initial state is estimated are left out.

    Parameters
    ----------
    simulations
        Simulations of the problem's experiments, with trajectories.
    fitted
        Whether they are at the estimates of a fit; the errors must then exceed those later on.
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
    """Return a note on wrong initial states of a fitted model, with advice."""
    found = initial_errors(problem, simulations, fitted=True)
    if not found:
        return ()
    return (f"{found[0].sentence}, but later errors are smaller: {free_start_advice(problem)}",)


def free_start_advice(problem: Problem) -> str:
    """Return advice on the config keys that estimate or set initial states of experiments."""
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
    """Return whether an unknown of an experiment is a start value, or is its own."""
    for unknown in space.unknowns:
        start = is_start_value(unknown.parameter, description)
        if experiment in unknown.experiments and (start or unknown.parameter.per):
            return True
    return False


def is_start_value(parameter: Parameter, description: ModelDescription) -> bool:
    """Return whether a parameter is the start value of a variable of the model."""
    found = description.variables.get(parameter.target)
    return found is not None and found.causality not in ("parameter", "input")


def noise_of_samples(values: FloatArray) -> float:
    """Return the noise of a signal from its second differences; 0 if the signal is too short."""
    if len(values) < 4:
        return 0.0
    return float(1.4826 * np.median(np.abs(np.diff(values, 2))) / np.sqrt(6.0))


def _begins(experiment: Experiment, output: Output) -> bool:
    """Return whether an output is measured at the start of its experiment or one sample later."""
    if len(output.times) < 4:
        return False
    step = float(np.median(np.diff(output.times)))
    return bool(output.times[0] - experiment.start <= 1.5 * step)


def _off(output: Output, errors: FloatArray, *, fitted: bool) -> tuple[float, float]:
    """Return the error of a first sample and its ratio to the noise; zeros if it is too small."""
    noise = float(output.sigmas[0]) if output.has_sigma else noise_of_samples(output.values)
    first = abs(float(errors[0]))
    later = float(np.sqrt(np.mean(errors[len(errors) // 2 :] ** 2)))
    least = (
        OUTSTANDING * later if fitted else INITIAL_ERROR_OVER_SPREAD * float(np.std(output.values))
    )
    if not first > max(INITIAL_ERROR_OVER_NOISE * noise, least):
        return 0.0, 0.0
    return first, first / noise if noise > 0.0 else np.inf
