"""Estimate the parameters and initial states of an FMU from many measured experiments at once."""

from __future__ import annotations

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

__all__ = [
    "Budget",
    "ClusterEstError",
    "Estimate",
    "Experiment",
    "Input",
    "LeastSquares",
    "Model",
    "Output",
    "OutputError",
    "Parameter",
    "Problem",
    "Resources",
    "Result",
    "ScipyLeastSquares",
    "Solver",
    "build_problem",
    "fit",
    "parse_config",
    "read_config",
    "read_table",
    "simulate",
]
