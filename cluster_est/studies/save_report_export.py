"""Save, report and export a result from Python, as the command line does."""

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
    """Write a run folder that `cluster-est show` and `report` read; it has no log of simulations.

    Parameters
    ----------
    result
        Of `fit` or `close_loop`.
    folder
        Must be new or empty, unless `overwrite`.
    overwrite
        Whether to replace the run that is there.

    Raises
    ------
    ProblemError
        If it is no such result.
    RunFolderError
        If the folder holds something already or cannot be written.
    """
    fitted = _fit_of(result)
    path = as_path(folder, "folder", ProblemError)
    kind = RunKind.FIT if isinstance(result, Result) else RunKind.CLOSED_LOOP
    identity = RunIdentity(kind, fitted.problem, NO_CONFIG, "", fitted.seed)
    RunFolder(path, identity, overwrite=overwrite).write(result)
    return path


def report(result: Result | LoopResult, path: str | Path) -> Path:
    """Write the report of a result: one HTML file.

    Raises
    ------
    ProblemError
        If it is no result of `fit` or `close_loop`.
    RunFolderError
        If it cannot be written.
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
    """Write the model with its estimates and effects, as `cluster-est export` does.

    Parameters
    ----------
    result
        Of `fit` or `close_loop`.
    fmu, ssv, csv
        Files to write: an FMU that holds the original and the effects, a set of parameters as SSP
        has them, and as a table.
    modelica, text
        Whether a Modelica class and a description are wanted, in `printed` of what comes back.
    experiment
        Whose values are taken, where parameters have one for each; None for shared ones alone.
    measure
        Whether the communication step is measured that reproduces the error.

    Raises
    ------
    ClusterEstError
        If nothing is asked for, or a file cannot be written.
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
    """Return the fit that a result is or ends with."""
    if isinstance(result, LoopResult):
        return result.after
    if not isinstance(result, Result):
        raise ProblemError(
            f"result: must be the result of fit or close_loop, but is {type(result).__name__}; "
            "call one of these first"
        )
    return result
