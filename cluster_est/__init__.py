"""Estimate the parameters and initial states of an FMU from many measured experiments at once.

`read_problem` and `fit`, or `close_loop`, are where to begin. What is not named here is imported
from its own module, such as `cluster_est.methods` for the methods.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cluster_est.config.build import build_problem, read_problem
from cluster_est.config.reader import read_config
from cluster_est.errors import ClusterEstError
from cluster_est.fit import fit, simulate
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.fmu_file import read_model
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.tables.experiment import experiment_from_table
from cluster_est.problem.tables.files import read_table
from cluster_est.residual_function import residuals
from cluster_est.results.result import Result
from cluster_est.results.row_types import Estimate
from cluster_est.running.multistart import Multistart
from cluster_est.running.records import Budget
from cluster_est.running.resources import Resources
from cluster_est.uncertainty import UncertaintySettings
from workers.messages import Effect, Experiment, Input, Model, Output, Solver

if TYPE_CHECKING:
    from cluster_est.closed_loop.diagnostics import add_effect, detect, locate
    from cluster_est.closed_loop.findings.result import LoopResult
    from cluster_est.closed_loop.loop import close_loop
    from cluster_est.closed_loop.settings import LoopSettings

__all__ = [
    "Budget",
    "ClusterEstError",
    "Effect",
    "Estimate",
    "Experiment",
    "Input",
    "LeastSquares",
    "LoopResult",
    "LoopSettings",
    "Model",
    "Multistart",
    "Output",
    "Parameter",
    "Problem",
    "Resources",
    "Result",
    "Solver",
    "UncertaintySettings",
    "add_effect",
    "build_problem",
    "close_loop",
    "detect",
    "fit",
    "locate",
    "read_config",
    "read_model",
    "read_problem",
    "read_table",
    "residuals",
    "simulate",
]

Experiment.from_table = staticmethod(experiment_from_table)
"""Here because `workers`, where the class stands, reads no tables."""

_LATE = {
    "LoopResult": "findings.result",
    "LoopSettings": "settings",
    "add_effect": "diagnostics",
    "close_loop": "loop",
    "detect": "diagnostics",
    "locate": "diagnostics",
}
"""Names that are imported when they are first used: a fit has no need of SymPy."""


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"cluster_est.closed_loop.{_LATE[name]}"), name)


def __dir__() -> list[str]:
    return __all__
