"""What a simulation resolves in time: the step at which an FMU exchanges inputs and outputs."""

from __future__ import annotations

import math

from workers.fmu.description import ModelDescription
from workers.messages import Model


def communication_step(model: Model, description: ModelDescription) -> float:
    """Return the step of an FMU that communicates in steps of one length, in seconds.

    Between two such points its inputs are held and its outputs interpolated, however short the
    interval of the data. 0.0 where every time in the data is such a point, or no step is known
    before an experiment is.
    """
    if model.interface != "co_simulation" or description.variable_steps:
        return 0.0
    own = (model.solver.step, description.fixed_internal_step, description.default_step)
    return next((step for step in own if step is not None and step > 0.0), 0.0)


def fixed_step(model: Model) -> float:
    """Return the longest step of a solver that does not shorten it where something switches.

    In seconds; infinite where one step goes from each time in the data to the next, 0.0 for solvers
    that control their error.
    """
    if model.solver.name != "rk4":
        return 0.0
    return model.solver.step or math.inf
