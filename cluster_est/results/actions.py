"""Save, report and export a result from Python, as the command line does.

Results stand below the rooms that do this. They reach up from here alone, by imports when they are
asked to: the one exception to the rule that imports run down.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cluster_est.errors import ProblemError
from workers.messages.checks import as_path, as_tuple, check_name

if TYPE_CHECKING:
    from cluster_est.closed_loop.findings.result import LoopResult
    from cluster_est.export.write import ExportResult
    from cluster_est.results.result import Result

NO_CONFIG = "# saved from Python: there is no config\n"


def save(result: Result | LoopResult, folder: str | Path, *, overwrite: bool) -> Path:
    """Write a run folder, without a log of its simulations.

    Raises
    ------
    RunFolderError
        If the folder holds something already or cannot be written.
    """
    from cluster_est.results.result import Result
    from cluster_est.run_folder.run_folder import RunFolder
    from cluster_est.run_folder.run_identity import RunIdentity, RunKind

    path = as_path(folder, "folder", ProblemError)
    fitted = result if isinstance(result, Result) else result.after
    kind = RunKind.FIT if isinstance(result, Result) else RunKind.CLOSED_LOOP
    identity = RunIdentity(kind, fitted.problem, NO_CONFIG, "", fitted.seed)
    RunFolder(path, identity, overwrite=overwrite).write(result)
    return path


def report(result: Result | LoopResult, path: str | Path) -> Path:
    """Write the report of a result: one HTML file.

    Raises
    ------
    RunFolderError
        If it cannot be written.
    """
    from cluster_est.report.page import write_report

    path = as_path(path, "path", ProblemError)
    with tempfile.TemporaryDirectory() as folder:
        run = save(result, Path(folder) / (path.stem or "run"), overwrite=False)
        return write_report(run, path)


def export(
    result: Result | LoopResult,
    fmu: str | Path | None,
    ssv: str | Path | None,
    *,
    csv: str | Path | None,
    modelica: bool,
    text: bool,
    experiment: str | None,
    platforms: Sequence[str] = (),
    measure: bool = True,
) -> ExportResult:
    """Write the model with its estimates and effects, as `cluster-est export` does.

    Raises
    ------
    ClusterEstError
        If nothing is asked for, or a file cannot be written.
    """
    from cluster_est.export.repaired_fmu import FmuOptions
    from cluster_est.export.repaired_model import repaired
    from cluster_est.export.write import ExportRequest, check_request, write_forms
    from cluster_est.results.result import Result

    wanted = ExportRequest(
        None if fmu is None else as_path(fmu, "fmu", ProblemError),
        None if ssv is None else as_path(ssv, "ssv", ProblemError),
        None if csv is None else as_path(csv, "csv", ProblemError),
        modelica,
        text,
        FmuOptions(as_tuple(platforms, str, "platforms", ProblemError), measure),
    )
    check_request(wanted)
    if experiment is not None:
        check_name(experiment, "experiment", ProblemError)
    fitted = result if isinstance(result, Result) else result.after
    errors = result.table("errors").to_pylist()
    closed = fitted is not result
    repair = repaired(fitted.problem, fitted.estimates, experiment, errors=errors, fitted=closed)
    return write_forms(repair, wanted)
