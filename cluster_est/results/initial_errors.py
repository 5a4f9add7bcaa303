"""Errors at the first sample, which show that the initial state of an experiment is wrong.

The error of a wrong initial state decays or remains as an offset. It looks like a missing effect,
and no parameter removes it. At the first sample, the residual contains only this error and noise.
If the error of one output decays while all other outputs fit, its sensor probably has to settle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

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
FEWEST_SAMPLES = 5
"""Least number of samples that show that an error has decayed."""
FEW_LARGE = 0.1
"""Largest share of larger errors after an error has decayed."""
LONGEST_SETTLING = 0.25
"""Longest settling time of a sensor, over the length of the record."""
IN_PROPORTION = 0.2
"""Largest ratio of another output's error at the start to the error of the output that settles,
each over the standard deviation of its measured values."""
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
    settling
        Seconds until the error is noise, if all other outputs fit from the start; otherwise 0.
    others
        These other outputs.
    """

    output: str
    unit: str
    distance: float
    over_noise: float
    found: int
    count: int
    settling: float = 0.0
    others: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """The size of the error, and the experiments, as a sentence."""
        size = f"{self.distance:.3g} {self.unit}".strip()
        if self.settling:
            runs = "experiments" if self.count > 1 else "experiment"
            fit = "fits" if len(self.others) == 1 else "fit"
            return (
                f"at the start of {self.found} of {self.count} {runs}, only {self.output} differs "
                f"from the model: at the first sample, it is off by up to {size}, "
                f"{self.over_noise:.3g} times its noise, and this error decays within about "
                f"{self.settling:g} s, while {' and '.join(self.others)} {fit} from the first "
                "sample"
            )
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
    begins: dict[str, list[_Begin]] = {}
    for each in simulations:
        if estimates_start(space, each.experiment, description):
            continue
        experiment = problem.experiments[each.experiment]
        for begin in _begins_of(experiment, each, fitted=fitted):
            begins.setdefault(begin.output, []).append(begin)
    found = []
    for name, own in begins.items():
        far = [each for each in own if each.distance > 0.0]
        if far and 2 * len(far) >= len(own):
            worst = max(far, key=lambda each: (each.distance, each.over_noise))
            alone = all(each.settling for each in far)
            found.append(
                InitialError(
                    name, description.variables[name].unit, worst.distance, worst.over_noise,
                    len(far), len(own), max(each.settling for each in far) if alone else 0.0,
                    worst.others if alone else (),
                )
            )  # fmt: skip
    return tuple(sorted(found, key=lambda each: -each.over_noise))


def initial_notes(problem: Problem, simulations: Sequence[Simulation]) -> tuple[str, ...]:
    """Return a note on wrong initial states of a fitted model, with advice."""
    found = initial_errors(problem, simulations, fitted=True)
    if not found:
        return ()
    but = "" if found[0].settling else ", but later errors are smaller"
    return (f"{found[0].sentence}{but}: {start_advice(problem, found[0])}",)


def start_advice(problem: Problem, error: InitialError) -> str:
    """Return advice on an error at the first sample."""
    if not error.settling:
        return free_start_advice(problem)
    others = " and ".join(error.others)
    do = "depends" if len(error.others) == 1 else "depend"
    return (
        f"if {others} {do} on the same initial states, these states are right, and the sensor "
        f"or the logger of {error.output} needs time to settle: leave this time out with warm_up = "
        f"{error.settling:g} in experiment_defaults; otherwise {free_start_advice(problem)}"
    )


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


@dataclass(frozen=True)
class _Begin:
    """The start of one output of one experiment; a distance of 0 is no error.

    The other attributes are those of `InitialError`.
    """

    output: str
    distance: float
    over_noise: float
    settling: float = 0.0
    others: tuple[str, ...] = ()


def _begins_of(experiment: Experiment, simulation: Simulation, *, fitted: bool) -> list[_Begin]:
    """Return the starts of the outputs of an experiment."""
    errors: dict[str, FloatArray] = {}
    outputs = {output.variable: output for output in experiment.outputs if not output.ordinal}
    for name, output in outputs.items():
        residuals = output_residuals(output, simulation.outcome)
        if residuals is not None and _begins(experiment, output):
            errors[name] = residuals * output.sigmas
    found = {name: _off(outputs[name], own, fitted=fitted) for name, own in errors.items()}
    begins = []
    for name, (distance, over_noise) in found.items():
        settling, others = 0.0, tuple(n for n in errors if n != name)
        spread = float(np.std(outputs[name].values))
        if distance and spread and others and not any(found[n][0] for n in others):
            until, settling = _settling(outputs[name], errors[name])
            share = distance / spread
            right = (_fits(outputs[n], errors[n], until, share) for n in others)
            settling = settling if settling and all(right) else 0.0
        begins.append(_Begin(name, distance, over_noise, settling, others if settling else ()))
    return begins


def _settling(output: Output, errors: FloatArray) -> tuple[float, float]:
    """Return the time of the decay of an error at the first sample, and its settling time.

    The first is the time at which the error is as small as later errors, and remains so for as long
    again. From it, the second is extrapolated to a third of the noise, as for an exponential decay,
    in seconds after the first sample. Both are 0 if the error does not decay.
    """
    sizes, count = np.abs(errors), len(errors)
    noise = _noise(output)
    floor = max(float(np.quantile(sizes[count // 2 :], 0.95)), 3.0 * noise)
    if not sizes[0] > floor:
        return 0.0, 0.0
    large = np.flatnonzero(sizes > floor)
    for i in (large + 1).tolist():
        if i > LONGEST_SETTLING * count:
            break
        again = i + FEWEST_SAMPLES
        if np.count_nonzero((large >= i) & (large < i + again)) <= FEW_LARGE * again:
            until = float(output.times[i] - output.times[0])
            ratio = np.log(3.0 * sizes[0] / noise) / np.log(sizes[0] / floor) if noise else 1.0
            settling = float(np.format_float_positional(until * ratio, 2, fractional=False))
            longest = LONGEST_SETTLING * (output.times[-1] - output.times[0])
            return (until, settling) if settling <= longest else (0.0, 0.0)
    return 0.0, 0.0


def _fits(output: Output, errors: FloatArray, until: float, share: float) -> bool:
    """Return whether an output fits at the start, for twice the decay of another output's error.

    `share` is the other output's error at the first sample over its standard deviation.
    """
    early: npt.NDArray[np.bool_] = output.times <= output.times[0] + 2.0 * until
    spread = float(np.std(output.values))
    if np.count_nonzero(early) < FEWEST_SAMPLES or spread == 0.0:
        return False
    later = float(np.sqrt(np.mean(errors[len(errors) // 2 :] ** 2)))
    size = float(np.sqrt(np.mean(errors[early] ** 2)))
    least = max(OUTSTANDING * later, 3.0 * _noise(output))
    return size <= min(least, IN_PROPORTION * share * spread)


def _noise(output: Output) -> float:
    return float(output.sigmas[0]) if output.has_sigma else noise_of_samples(output.values)


def _begins(experiment: Experiment, output: Output) -> bool:
    """Return whether an output is measured at the start of its experiment or one sample later."""
    if len(output.times) < 4:
        return False
    step = float(np.median(np.diff(output.times)))
    return bool(output.times[0] - experiment.start <= 1.5 * step)


def _off(output: Output, errors: FloatArray, *, fitted: bool) -> tuple[float, float]:
    """Return the error of a first sample and its ratio to the noise; zeros if it is too small."""
    noise = _noise(output)
    first = abs(float(errors[0]))
    later = float(np.sqrt(np.mean(errors[len(errors) // 2 :] ** 2)))
    least = (
        OUTSTANDING * later if fitted else INITIAL_ERROR_OVER_SPREAD * float(np.std(output.values))
    )
    if not first > max(INITIAL_ERROR_OVER_NOISE * noise, least):
        return 0.0, 0.0
    return first, first / noise if noise > 0.0 else np.inf
