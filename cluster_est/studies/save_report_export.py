"""Saves, reports and exports a result from Python, like the command line."""

from __future__ import annotations

import tempfile
from pathlib import Path

from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.errors import ProblemError
from cluster_est.html_report.page import write_report
from cluster_est.model_export.repaired_model import repaired
from cluster_est.model_export.write import ExportRequest, ExportResult, check_request, write_forms
from cluster_est.results.result import Result
from cluster_est.run_folder.run_folder import RunFolder
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from workers.messages.checks import as_path, check_name

NO_CONFIG = "# saved from Python: there is no config\n"


def save(result: Result | LoopResult, folder: str | Path, *, overwrite: bool = False) -> Path:
    """Write a run folder for `cluster-est show` and `report`, without a log of simulations.

    Parameters
    ----------
    result
        Result of `fit` or `close_loop`.
    folder
        The folder; it must be new or empty, unless `overwrite` is true.
    overwrite
        Whether to replace an existing run.

    Raises
    ------
    ProblemError
        If `result` is not such a result.
    RunFolderError
        If the folder is not empty or cannot be written.
    """
    fitted = _fit_of(result)
    path = as_path(folder, "folder", ProblemError)
    kind = RunKind.FIT if isinstance(result, Result) else RunKind.CLOSED_LOOP
    identity = RunIdentity(kind, fitted.problem, NO_CONFIG, "", fitted.seed)
    RunFolder(path, identity, overwrite=overwrite).write(result)
    return path


def report(result: Result | LoopResult, path: str | Path) -> Path:
    """Write the report of a result as one HTML file.

    Raises
    ------
    ProblemError
        If `result` is not a result of `fit` or `close_loop`.
    RunFolderError
        If the report cannot be written.
    """
    path = as_path(path, "path", ProblemError)
    with tempfile.TemporaryDirectory() as folder:
        run = save(result, Path(folder) / (path.stem or "run"))
        return write_report(run, path)


def export(
    result: Result | LoopResult,
    fmu: str | Path | None = None,
    ssv: str | Path | None = None,
    *,
    csv: str | Path | None = None,
    modelica: bool = False,
    text: bool = False,
    experiment: str | None = None,
    measure: bool = True,
) -> ExportResult:
    """Write the model with its estimates and effects, like `cluster-est export`.

    Parameters
    ----------
    result
        Result of `fit` or `close_loop`.
    fmu, ssv, csv
        Files to write: an FMU with the original FMU and the effects, a parameter set in the SSP
        format, and a table of parameters.
    modelica, text
        Whether to return a Modelica class and a description in `printed` of the result.
    experiment
        The experiment whose values are used, for parameters with one value per experiment; None for
        only shared parameters.
    measure
        Whether to determine the communication step that reproduces the error.

    Raises
    ------
    ClusterEstError
        If nothing is requested, or a file cannot be written.
    """
    fitted = _fit_of(result)
    wanted = ExportRequest(
        None if fmu is None else as_path(fmu, "fmu", ProblemError),
        None if ssv is None else as_path(ssv, "ssv", ProblemError),
        None if csv is None else as_path(csv, "csv", ProblemError),
        modelica,
        text,
        measure,
    )
    check_request(wanted)
    if experiment is not None:
        check_name(experiment, "experiment", ProblemError)
    errors = result.table("errors").to_pylist()
    closed = fitted is not result
    repair = repaired(fitted.problem, fitted.estimates, experiment, errors=errors, fitted=closed)
    return write_forms(repair, wanted)


def _fit_of(result: Result | LoopResult) -> Result:
    """Return the fit of a result; for a closed loop, the final fit."""
    if isinstance(result, LoopResult):
        return result.after
    if not isinstance(result, Result):
        raise ProblemError(
            f"result: must be the result of fit or close_loop, but is {type(result).__name__}; "
            "call one of these first"
        )
    return result
