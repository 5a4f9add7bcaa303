"""Whether a fit has the model carry its sensitivities, where the config leaves that open.

One simulation that carries p of them costs about as much as the p further ones that differences
take, if the FMU's directional derivatives cost as much as its derivatives. Some give them for much
less. So both are timed on the first worker before a search begins, and the run keeps to what was
found, also where it is taken up again. Short fits are not worth the trial.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

from cluster_est.executors import WorkerPool
from cluster_est.methods.base import Method
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.methods.sqp.method import Sqp
from cluster_est.problem.problem import Problem
from cluster_est.problem.space import SearchSpace
from workers.messages import Task, Want

LEAST_SECONDS = 1.0
"""Of all simulations that differences take for one Jacobian; with less, nothing is timed."""
CHEAPER = 0.5
"""Part of the time of differences from which sensitivities take their place. Far from 1, so that
it is the same each time, though times are not."""
REPEATS = 2
"""The quicker of so many counts: the first may have something to prepare."""


@dataclass(frozen=True)
class SensitivityDecision:
    """Whether sensitivities take the place of differences, and why.

    Attributes
    ----------
    carry
        Whether they do.
    sentence
        What was found; "" if nothing was tried.
    """

    carry: bool
    sentence: str = ""


def recorded_slopes(facts: Mapping[str, Any]) -> SensitivityDecision:
    """What a run had found, by its run.json; differences if that does not say."""
    found = facts.get("sensitivities") or {}
    return SensitivityDecision(bool(found.get("carry")), str(found.get("sentence") or ""))


def cheaper_slopes(executor: WorkerPool, space: SearchSpace, method: Method) -> SensitivityDecision:
    """Time both, where there is a choice, and that costs little beside the search.

    Parameters
    ----------
    executor
        Nothing was asked of it yet.
    space
        Of the training experiments.
    method
        As the config has it.
    """
    if not _is_open(space.problem, method):
        return SensitivityDecision(False)
    columns = [len(acting) for acting in space.acting]
    place = max(range(len(columns)), key=columns.__getitem__)
    plain = _seconds(executor, space, place, "residuals")
    if plain is None or plain * sum(columns) < LEAST_SECONDS:
        return SensitivityDecision(False)
    carried = _seconds(executor, space, place, "sensitivities")
    if carried is None:
        return SensitivityDecision(False)
    part = carried / (plain * columns[place])
    said = f"one simulation with sensitivities takes {part:.2g} of the time that differences take"
    return SensitivityDecision(part <= CHEAPER, said)


def with_slopes(method: Method, found: SensitivityDecision) -> Method:
    """The method, told to take sensitivities if they are cheaper."""
    if found.carry and _has_choice(method):
        return replace(method, differences="sensitivities")
    return method


def _has_choice(method: Method) -> TypeGuard[LeastSquares | Sqp]:
    """Whether a method can take derivatives from either, and the config leaves it open."""
    return isinstance(method, LeastSquares | Sqp) and method.differences == "auto"


def _is_open(problem: Problem, method: Method) -> bool:
    """Whether both are possible, as far as can be told without a simulation."""
    if not _has_choice(method) or problem.effects or problem.model.interface != "model_exchange":
        return False
    return problem.describe().offer("model_exchange").provides_directional_derivatives


def _seconds(executor: WorkerPool, space: SearchSpace, place: int, want: Want) -> float | None:
    """What one simulation takes at the start; None if there is no answer, or not what is wanted."""
    count = len(space.problem.model.parameters)
    values = space.physical(space.start)[place, :count]
    task = Task(0, space.experiments[place], values, want)
    outcomes = executor.first_worker([task] * REPEATS)
    given = [o for o in outcomes if o.ok and (want == "residuals" or o.sensitivities is not None)]
    return min(o.seconds for o in given) if len(given) == REPEATS else None
