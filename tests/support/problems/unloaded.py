"""Problems whose FMU is never loaded: for tests of what happens before and after simulations."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.problem.formulas import parse_constraint
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from workers.messages import Experiment, Model, Output, Solver


def unloaded_problem(
    parameters: Sequence[Parameter],
    experiments: int = 1,
    constraints: Sequence[str] = (),
    known: Mapping[int, Mapping[str, float]] | None = None,
    scale: float = 1.0,
    **changes: object,
) -> Problem:
    """Experiments e0, e1, ... with three samples of y each, and two groups.

    `known` are values by number of the experiment, `changes` of all experiments.
    """
    seen, runs = Output("y", np.array([0.0, 1.0, 2.0]), np.zeros(3)), []
    for i in range(experiments):
        values = tuple((known or {}).get(i, {}).items())
        groups = ("rig", "AB"[i % 2]), ("day", f"d{i // 3}")
        runs.append(Experiment(f"e{i}", 0.0, 2.0, (), (seen,), values=values, groups=groups))
    targets = tuple(p.target for p in parameters if not p.auxiliary)
    names = tuple(p.name for p in parameters)
    found = [c for text in constraints for c in parse_constraint(text, names, "here", scale=scale)]
    return Problem(
        Model("none.fmu", b"", "model_exchange", Solver("rk4"), targets),
        tuple(parameters),
        tuple(replace(run, **changes) for run in runs),  # type: ignore[arg-type]
        constraints=tuple(found),
    )
