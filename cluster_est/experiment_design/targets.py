"""Targets of predictions: outputs of recorded or planned experiments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.problem.problem import Problem
from workers.fmu.description import ModelDescription, nearest
from workers.messages import Experiment, FloatArray, Output
from workers.messages.checks import as_tuple, shown


@dataclass(frozen=True)
class PredictionTarget:
    """Outputs of an experiment whose prediction should become accurate.

    Attributes
    ----------
    experiment
        Name of an experiment of the run, including test experiments; "" for all of them. Or a
        planned experiment: its missing inputs, signals, start values and groups are those of the
        experiment whose start the next experiment has.
    outputs
        The FMU's names. Empty for the outputs measured in the experiment, or without these, for all
        outputs measured in the run. They count at its measured times; without these, at the times
        of its inputs.

    Raises
    ------
    ProblemError
        If one is of the wrong type.
    """

    experiment: str | Experiment = ""
    outputs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.experiment, str | Experiment):
            raise ProblemError(
                "predictions: experiment must be the name of an experiment, or an Experiment, but "
                f"is {shown(self.experiment)}"
            )
        outputs = as_tuple(self.outputs, str, "predictions: outputs", ProblemError)
        object.__setattr__(self, "outputs", outputs)


def target_experiments(
    targets: Sequence[PredictionTarget], problem: Problem, like: Experiment
) -> tuple[Experiment, ...]:
    """Return the experiments to predict, with the outputs that count.

    Their outputs have the value 0 and no sigma, so residuals are the predictions.

    Parameters
    ----------
    targets
        Named outputs and experiments; without any, all outputs of all experiments.
    problem
        Problem of the run.
    like
        The experiment whose start the next experiment has.

    Raises
    ------
    ProblemError
        If a name does not exist, or there is nothing to predict.
    """
    description = problem.describe()
    found: dict[str, dict[str, Output]] = {}
    known = {experiment.id: experiment for experiment in problem.experiments}
    planned: dict[str, Experiment] = {}
    for target in targets or (PredictionTarget(),):
        for experiment in _experiments(target, known, planned, like):
            names = target.outputs or _measured(experiment) or _measured(*problem.experiments)
            if not target.outputs and not target.experiment:
                names = _measured(experiment)
            for name in names:
                output = _output(experiment, name, description)
                found.setdefault(experiment.id, {}).setdefault(name, output)
    return tuple(
        replace(
            known[name],
            role="train",
            outputs=tuple(outputs.values()),
            curve=None,
            bounds=(),
            cost_function=None,
            constraint_functions=(),
        )
        for name, outputs in found.items()
    )


def _experiments(
    target: PredictionTarget,
    known: dict[str, Experiment],
    planned: dict[str, Experiment],
    like: Experiment,
) -> list[Experiment]:
    """Return the experiments that a target names.

    A planned experiment is completed and added to `known`; `planned` keeps its original.
    """
    own = target.experiment
    if isinstance(own, Experiment):
        if own.id in known and planned.get(own.id) is not own:
            raise ProblemError(
                f"predictions: a planned experiment must have a unique name, but {own.id!r} is the "
                "name of another one; rename it"
            )
        planned[own.id] = own
        known[own.id] = _completed(own, like)
        return [known[own.id]]
    if not own:
        return [experiment for name, experiment in known.items() if name not in planned]
    if own not in known:
        raise ProblemError(
            "predictions: experiment must be an experiment of the run, but is "
            f"{own!r}{nearest(own, known)}"
        )
    return [known[own]]


def _completed(given: Experiment, like: Experiment) -> Experiment:
    """Return a planned experiment, with missing parts from the similar experiment."""
    inputs = {each.variable for each in given.inputs}
    signals = {each.variable for each in given.signals}
    return replace(
        given,
        inputs=(*given.inputs, *(g for g in like.inputs if g.variable not in inputs)),
        signals=(*given.signals, *(g for g in like.signals if g.variable not in signals)),
        values=tuple({**dict(like.values), **dict(given.values)}.items()),
        groups=tuple({**dict(like.groups), **dict(given.groups)}.items()),
    )


def _measured(*experiments: Experiment) -> tuple[str, ...]:
    names = (o.variable for e in experiments for o in e.outputs if len(o.times))
    return tuple(dict.fromkeys(names))


def _output(experiment: Experiment, name: str, description: ModelDescription) -> Output:
    """Return an output at the times at which it counts."""
    numbers = [
        v.name
        for v in description.variables.values()
        if v.causality in ("output", "local") and v.type.startswith("Float")
    ]
    if name not in numbers:
        raise ProblemError(
            "predictions: outputs must be variables that the FMU computes, but "
            f"{name!r} is not{nearest(name, numbers)}"
        )
    own = [o.times for o in experiment.outputs if o.variable == name and len(o.times)]
    others = [o.times for o in experiment.outputs if len(o.times)]
    driven = [_within(each.times, experiment) for each in experiment.inputs]
    times = next((each for each in (*own, *others, *driven) if len(each)), None)
    if times is None:
        raise ProblemError(
            f"predictions: experiment {experiment.id!r} must have an input or a measured output to "
            "define the times of the prediction, but has neither; name another experiment"
        )
    return Output(name, times, np.zeros(len(times)))


def _within(times: FloatArray, experiment: Experiment) -> FloatArray:
    inside = (times >= experiment.start) & (times <= experiment.stop)
    return np.ascontiguousarray(times[inside])
