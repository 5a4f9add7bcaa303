"""Estimate the parameters and initial states of an FMU from many measured experiments at once."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cluster_est.build import build_problem
from cluster_est.config import parse_config, read_config
from cluster_est.data import read_table
from cluster_est.errors import ClusterEstError
from cluster_est.fit import fit, simulate
from cluster_est.methods.least_squares import LeastSquares
from cluster_est.methods.scipy_least_squares import ScipyLeastSquares
from cluster_est.problem import Parameter, Problem
from cluster_est.resources import Resources
from cluster_est.result import Estimate, OutputError, Result
from cluster_est.runner import Budget
from workers.messages import Experiment, Input, Model, Output, Solver

if TYPE_CHECKING:
    from cluster_est.closed_loop.loop import close_loop
    from cluster_est.closed_loop.parts import Detection, add_effect, detect, locate
    from cluster_est.closed_loop.result import Finding, LoopResult
    from cluster_est.closed_loop.settings import LoopSettings

__all__ = [
    "Budget",
    "ClusterEstError",
    "Detection",
    "Estimate",
    "Experiment",
    "Finding",
    "Input",
    "LeastSquares",
    "LoopResult",
    "LoopSettings",
    "Model",
    "Output",
    "OutputError",
    "Parameter",
    "Problem",
    "Resources",
    "Result",
    "ScipyLeastSquares",
    "Solver",
    "add_effect",
    "build_problem",
    "close_loop",
    "detect",
    "fit",
    "locate",
    "parse_config",
    "read_config",
    "read_table",
    "simulate",
]

_LATE = {
    "Detection": "parts",
    "Finding": "result",
    "LoopResult": "result",
    "LoopSettings": "settings",
    "add_effect": "parts",
    "close_loop": "loop",
    "detect": "parts",
    "locate": "parts",
}
"""What is imported when it is first used: a fit has no need of SymPy."""


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"cluster_est.closed_loop.{_LATE[name]}"), name)
