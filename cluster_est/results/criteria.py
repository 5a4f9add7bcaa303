"""Information criteria of a fit: AIC, AICc and BIC, if its cost is a likelihood.

With the maximum likelihood L of n measured values and k estimated values,

    AIC = 2 k - 2 ln L,    AICc = AIC + 2 k (k + 1) / (n - k - 1),    BIC = k ln n - 2 ln L:

H. Akaike, IEEE Trans. Automat. Control 19 (1974) 716-723, doi:10.1109/TAC.1974.1100705; C. M.
Hurvich, C.-L. Tsai, Biometrika 76 (1989) 297-307, doi:10.1093/biomet/76.2.297; G. Schwarz, Ann.
Statist. 6 (1978) 461-464, doi:10.1214/aos/1176344136.

The criteria assume normal, white noise. With autocorrelated residuals, n overestimates the
information, and all three criteria prefer models that are too large. Use held-out data then.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from cluster_est.problem.costs import GaussianLikelihood, SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from workers.messages import FloatArray, Output
from workers.messages.types import content_hash


@dataclass(frozen=True)
class InformationCriteria:
    """Criteria to compare fits of the same measured values; smaller is better.

    Attributes
    ----------
    log_likelihood
        ln L, where L is a density of the measured values in their units; NaN without criteria.
    observations, estimated
        n and k; k includes the estimated noise levels.
    aic, aicc, bic
        See the module. `aicc` is infinite if n <= k + 1.
    data
        Hash of the measured training values; only fits of the same values can be compared.
    why_not
        The reason why there are no criteria; "" if there are.
    """

    log_likelihood: float = math.nan
    observations: int = 0
    estimated: int = 0
    aic: float = math.nan
    aicc: float = math.nan
    bic: float = math.nan
    data: str = ""
    why_not: str = ""

    @classmethod
    def of(cls, log_likelihood: float, observations: int, estimated: int, data: str = "") -> Self:
        """Return the criteria for a log likelihood."""
        n, k = observations, estimated
        aic = 2.0 * k - 2.0 * log_likelihood
        left = n - k - 1
        aicc = aic + 2.0 * k * (k + 1) / left if left > 0 else math.inf
        bic = k * math.log(n) - 2.0 * log_likelihood
        return cls(log_likelihood, n, k, aic, aicc, bic, data)

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any] | None) -> Self:
        """Return the criteria from run.json, in which NaN is null."""
        if not facts:
            return cls(why_not="this run was made by a version that did not compute them")
        known = {each.name for each in fields(cls)}
        named: dict[str, Any] = {key: value for key, value in facts.items() if key in known}
        named = {key: math.nan if value is None else value for key, value in named.items()}
        return cls(**named)


def information_criteria(
    problem: Problem, residuals: FloatArray | None, unknowns: int
) -> InformationCriteria:
    """Return the criteria of a fit; if they do not apply, NaN and the reason.

    There are three cases. With a sigma for every output and the cost "sse",

        -2 ln L = sum of r^2 + sum of ln(2 pi sigma^2).

    Without any sigma, "sse" assumes one sigma for all outputs. It is estimated: sigma^2 = S / n,
    with the sum of squares S, so that -2 ln L = n ln(2 pi S / n) + n. The cost "likelihood"
    estimates a sigma for each output.

    Parameters
    ----------
    problem
        Model, training experiments and cost.
    residuals
        (measured - simulated) / sigma of the training experiments; None if a simulation failed.
    unknowns
        Number of estimated values.
    """
    outputs = [o for e in problem.indices("train") for o in problem.experiments[e].outputs]
    why_not = _why_not(problem, outputs)
    count = sum(len(output.times) for output in outputs)
    if not why_not and (residuals is None or len(residuals) != count or not count):
        why_not = "not every training experiment could be simulated"
    if why_not or residuals is None:
        return InformationCriteria(why_not=why_not)
    sigmas = np.concatenate([output.sigmas for output in outputs])
    levels = float(np.add.reduce(np.log(2.0 * math.pi * sigmas**2)))
    names = np.concatenate([np.full(len(o.times), o.variable) for o in outputs])
    if isinstance(problem.cost, SumSquared) and any(output.has_sigma for output in outputs):
        deviance, noise = float(np.add.reduce(residuals**2)) + levels, 0
    else:
        alike = isinstance(problem.cost, SumSquared)
        groups = [residuals] if alike else [residuals[names == n] for n in dict.fromkeys(names)]
        deviance, noise = levels + sum(map(_estimated_noise, groups)), len(groups)
    if not math.isfinite(deviance):
        return InformationCriteria(why_not="the residuals are 0, so there is no noise to estimate")
    data = _hash_of(problem)
    return InformationCriteria.of(-0.5 * deviance, count, unknowns + noise, data)


def _estimated_noise(residuals: FloatArray) -> float:
    """Return -2 ln L with the best noise level, without the sum of ln(2 pi sigma^2)."""
    square = float(np.mean(residuals**2))
    return len(residuals) * (math.log(square) + 1.0) if square > 0.0 else -math.inf


def _why_not(problem: Problem, outputs: Iterable[Output]) -> str:
    """Return why the cost is not a likelihood of only the measured values; "" if it is."""
    given = [output.has_sigma for output in outputs]
    sums = isinstance(problem.cost, SumSquared)
    reasons = {
        f"the cost {problem.cost.name!r} is not a likelihood of normally distributed noise": not (
            sums or isinstance(problem.cost, GaussianLikelihood)
        ),
        (
            "curves, cost functions and constraints do not compare measured values with simulated "
            "ones"
        ): not problem.plain,
        ("priors add to the information in the measured values"): any(
            p.prior for p in problem.parameters
        ),
        "a model with process noise has a different likelihood, that of its innovations": bool(
            noise_names(problem)
        ),
        "an output has a free scale, a free offset, a detection limit or ordinal values": any(
            not output.is_plain for output in outputs
        ),
        "only some outputs have a sigma": sums and any(given) and not all(given),
    }
    return next((reason for reason, holds in reasons.items() if holds), "")


def _hash_of(problem: Problem) -> str:
    """Return a hash of the measured training values, independent of sigma."""
    parts: list[str | bytes] = []
    for e in problem.indices("train"):
        experiment = problem.experiments[e]
        for output in experiment.outputs:
            parts += [experiment.id, output.variable]
            parts += [output.times.tobytes(), output.values.tobytes()]
    return content_hash(parts)
