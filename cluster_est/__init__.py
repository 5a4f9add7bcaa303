"""Estimate the parameters and initial states of an FMU from many measured experiments at once.

`read_problem` and `fit`, or `close_loop`, are where to begin. What is not named here is imported
from its own module, such as `cluster_est.methods` for the methods.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cluster_est.closed_loop.diagnostics import add_effect, detect, locate
    from cluster_est.closed_loop.findings.result import LoopResult
    from cluster_est.closed_loop.loop import close_loop
    from cluster_est.closed_loop.settings import LoopSettings
    from cluster_est.config.build import build_problem, read_problem
    from cluster_est.config.reader import read_config
    from cluster_est.errors import ClusterEstError
    from cluster_est.experiment_design.design import design
    from cluster_est.experiment_design.limits import ExperimentLimits
    from cluster_est.experiment_design.request import DesignSettings
    from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
    from cluster_est.problem.costs import CauchyCost, HuberCost, SoftL1
    from cluster_est.problem.fmu_file import read_model
    from cluster_est.problem.parameter import Parameter
    from cluster_est.problem.priors import LogNormalPrior, NormalPrior
    from cluster_est.problem.problem import Problem
    from cluster_est.problem.tables.files import read_table
    from cluster_est.problem.tables.measured_table import Reading
    from cluster_est.problem.thinning import ThinningSettings
    from cluster_est.results.compare import compare
    from cluster_est.results.result import Result
    from cluster_est.run_folder.saved_result import load
    from cluster_est.running.multistart import Multistart
    from cluster_est.running.resources import Budget, Resources
    from cluster_est.sensitivity.analysis import analyse_sensitivity
    from cluster_est.sensitivity.settings import SensitivitySettings
    from cluster_est.shooting.record_segments import Shooting
    from cluster_est.studies.fit import fit, simulate
    from cluster_est.studies.residual_function import residuals
    from cluster_est.studies.save_report_export import export, report, save
    from cluster_est.uncertainty import UncertaintySettings
    from workers.messages import Effect, Experiment, Input, Limits, Model, Output, Solver


def _refuse_other_workers() -> None:
    """Say which package or module stands in the way of this project's `workers`."""
    own = Path(__file__).parents[1] / "workers"
    known = sys.modules.get("workers")
    found = find_spec("workers") if known is None else getattr(known, "__spec__", None)
    places = [] if found is None else list(found.submodule_search_locations or ())
    if own.is_dir() and not any(Path(place).resolve() == own.resolve() for place in places):
        where = None if found is None else found.origin or next(iter(places), None)
        raise ImportError(
            f"cluster_est needs its package 'workers' in {own.parent}, but Python finds {where} "
            "under that name first; rename it, or move it out of the folders from which Python "
            "imports"
        )


_refuse_other_workers()

__all__ = [
    "Budget",
    "CauchyCost",
    "ClusterEstError",
    "DesignSettings",
    "Effect",
    "Experiment",
    "ExperimentLimits",
    "HuberCost",
    "Input",
    "LeastSquares",
    "Limits",
    "LogNormalPrior",
    "LoopResult",
    "LoopSettings",
    "Model",
    "Multistart",
    "NormalPrior",
    "Output",
    "Parameter",
    "Problem",
    "Reading",
    "Resources",
    "Result",
    "SensitivitySettings",
    "Shooting",
    "SoftL1",
    "Solver",
    "ThinningSettings",
    "UncertaintySettings",
    "add_effect",
    "analyse_sensitivity",
    "build_problem",
    "close_loop",
    "compare",
    "design",
    "detect",
    "export",
    "fit",
    "load",
    "locate",
    "read_config",
    "read_model",
    "read_problem",
    "read_table",
    "report",
    "residuals",
    "save",
    "simulate",
]

_MODULES = {
    "cluster_est.closed_loop.diagnostics": (
        "add_effect",
        "detect",
        "locate",
    ),
    "cluster_est.closed_loop.findings.result": ("LoopResult",),
    "cluster_est.closed_loop.loop": ("close_loop",),
    "cluster_est.closed_loop.settings": ("LoopSettings",),
    "cluster_est.config.build": (
        "build_problem",
        "read_problem",
    ),
    "cluster_est.config.reader": ("read_config",),
    "cluster_est.errors": ("ClusterEstError",),
    "cluster_est.experiment_design.design": ("design",),
    "cluster_est.experiment_design.limits": ("ExperimentLimits",),
    "cluster_est.experiment_design.request": ("DesignSettings",),
    "cluster_est.methods.least_squares.levenberg_marquardt": ("LeastSquares",),
    "cluster_est.problem.costs": (
        "CauchyCost",
        "HuberCost",
        "SoftL1",
    ),
    "cluster_est.problem.fmu_file": ("read_model",),
    "cluster_est.problem.parameter": ("Parameter",),
    "cluster_est.problem.priors": (
        "LogNormalPrior",
        "NormalPrior",
    ),
    "cluster_est.problem.problem": ("Problem",),
    "cluster_est.problem.tables.files": ("read_table",),
    "cluster_est.problem.tables.measured_table": ("Reading",),
    "cluster_est.problem.thinning": ("ThinningSettings",),
    "cluster_est.results.compare": ("compare",),
    "cluster_est.results.result": ("Result",),
    "cluster_est.run_folder.saved_result": ("load",),
    "cluster_est.running.multistart": ("Multistart",),
    "cluster_est.running.resources": (
        "Budget",
        "Resources",
    ),
    "cluster_est.sensitivity.analysis": ("analyse_sensitivity",),
    "cluster_est.sensitivity.settings": ("SensitivitySettings",),
    "cluster_est.shooting.record_segments": ("Shooting",),
    "cluster_est.studies.fit": (
        "fit",
        "simulate",
    ),
    "cluster_est.studies.residual_function": ("residuals",),
    "cluster_est.studies.save_report_export": (
        "export",
        "report",
        "save",
    ),
    "cluster_est.uncertainty": ("UncertaintySettings",),
    "workers.messages": (
        "Effect",
        "Experiment",
        "Input",
        "Limits",
        "Model",
        "Output",
        "Solver",
    ),
}
"""Where each name stands. A module is imported when one of its names is first used."""

_WHERE = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_WHERE[name]), name)
    if name == "Experiment":  # `workers`, where the class stands, reads no tables
        tables = import_module("cluster_est.problem.tables.experiment_from_table")
        found.from_table = staticmethod(tables.experiment_from_table)
        found.hold_out = import_module("cluster_est.problem.held_out").hold_out
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
