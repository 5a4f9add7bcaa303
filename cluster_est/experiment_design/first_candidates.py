"""What the candidates of a request are made with, and those that were recorded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.experiment_design.candidates import RECORDED, CandidateInput, CandidateMaker
from cluster_est.experiment_design.limits import SignalLimits
from cluster_est.experiment_design.models import NoiseOfOutputs
from cluster_est.experiment_design.request import DesignRequest
from cluster_est.experiment_design.waveforms import WAVEFORMS
from cluster_est.problem.problem import Problem

BEYOND = 0.5
"""Of an output's range, by which an experiment may leave it where no limits are given."""


def candidate_maker(request: DesignRequest, noise: NoiseOfOutputs) -> CandidateMaker:
    """Return what makes experiments, with as much noise as the fit has found."""
    problem, like = request.problem, request.like
    sigmas = {
        output.variable: noise.over_sigma(output.variable) * usual_sigma(problem, output.variable)
        for output in like.outputs
        if len(output.times)
    }
    variables = problem.describe().variables
    wanted = request.settings.waveforms
    return CandidateMaker(
        request.limits,
        like,
        sigmas,
        tuple(name for name in WAVEFORMS if not wanted or name in wanted),
        {**seen_ranges(problem, tuple(sigmas)), **request.limits.signals},
        frozenset(
            name for name in request.limits.inputs if not variables[name].type.startswith("Float")
        ),
    )


def usual_sigma(problem: Problem, output: str) -> float:
    """Return the median over the training experiments of an output's sigma."""
    runs = [problem.experiments[e] for e in problem.indices("train")]
    own = [o for run in runs for o in run.outputs if o.variable == output and len(o.times)]
    return float(np.median([np.sqrt(np.mean(o.sigmas**2)) for o in own])) if own else 1.0


def seen_ranges(problem: Problem, outputs: Sequence[str]) -> dict[str, SignalLimits]:
    """Return the range of each output over all experiments, and half as much on either side.

    Further out nobody knows whether a model holds, nor whether the plant does.
    """
    found = {}
    for name in outputs:
        measured = np.concatenate(
            [o.values for e in problem.experiments for o in e.outputs if o.variable == name]
        )
        low, high = float(measured.min()), float(measured.max())
        room = BEYOND * max(high - low, 1e-9 * max(abs(low), abs(high), 1e-9))
        found[name] = SignalLimits(low - room, high + room)
    return found


def recorded_candidates(
    request: DesignRequest, maker: CandidateMaker
) -> tuple[CandidateInput, ...]:
    """Return the inputs of the run's experiments that keep the limits, where they may be chosen."""
    wanted = request.settings.waveforms
    if wanted and RECORDED not in wanted:
        return ()
    found = (maker.recorded(experiment) for experiment in request.problem.experiments)
    return tuple(each for each in found if each is not None)
