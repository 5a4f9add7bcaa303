"""The messages between coordinator and workers: frozen classes with arrays and strings.

The coordinator sends a `Model` and its `Experiment`s once to every worker. Then it sends `Task`s,
each with one point and one experiment. The worker answers each task with an `Outcome`, which may be
a failure.
"""

from workers.messages.measured_experiment import (
    Curve,
    Experiment,
    OwnStart,
    SignalBound,
)
from workers.messages.model import Effect, Model, Seats, Solver
from workers.messages.signals import Input, Output
from workers.messages.tasks import (
    Limits,
    Linearisation,
    MatrixSeries,
    Outcome,
    Status,
    Task,
    Trajectory,
)
from workers.messages.types import (
    REDUCTIONS,
    USUAL,
    FloatArray,
    GapRule,
    IntArray,
    Interface,
    Interpolation,
    Reduction,
    ResetPolicy,
    Role,
    SolverName,
    Value,
    Want,
    content_hash,
)
from workers.messages.user_function import UserFunction

__all__ = [
    "REDUCTIONS",
    "USUAL",
    "Curve",
    "Effect",
    "Experiment",
    "FloatArray",
    "GapRule",
    "Input",
    "IntArray",
    "Interface",
    "Interpolation",
    "Limits",
    "Linearisation",
    "MatrixSeries",
    "Model",
    "Outcome",
    "Output",
    "OwnStart",
    "Reduction",
    "ResetPolicy",
    "Role",
    "Seats",
    "SignalBound",
    "Solver",
    "SolverName",
    "Status",
    "Task",
    "Trajectory",
    "UserFunction",
    "Value",
    "Want",
    "content_hash",
]
