"""The JSON document that a command prints with `--json`: its fields, each declared here once.

`--fail-if` uses the same fields, and the documentation of the commands lists them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Literal

from cluster_est.cli.answer import Answer
from cluster_est.cli.parent_process import ExitCode

if TYPE_CHECKING:
    from cluster_est.run_folder.run_files import StoredRun

FieldKind = Literal["text", "number", "whole number", "true or false", "list", "object"]


def _statuses() -> tuple[str, ...]:
    return tuple(map(status_of, ExitCode))


def _run_statuses() -> tuple[str, ...]:
    from cluster_est.run_folder.run_files import RunStatus  # --help must not import pyarrow

    return tuple(each.value for each in RunStatus)


def verdicts() -> tuple[str, ...]:
    """Return the verdicts of a closed loop."""
    from cluster_est.closed_loop.findings.effects import Verdict  # only --fail-if needs SymPy

    return tuple(each.value for each in Verdict)


@dataclass(frozen=True)
class DocumentField:
    """A field of the document.

    Attributes
    ----------
    name, kind, meaning
        The kind is that of its value in JSON; null means a missing value or a number that is not
        finite.
    words
        Its possible texts, if known; `--fail-if` accepts them without quotes.
    """

    name: str
    kind: FieldKind
    meaning: str
    words: Callable[[], tuple[str, ...]] = tuple


COMMON_FIELDS = (
    DocumentField("command", "text", "name of the command"),
    DocumentField("version", "text", "version of cluster-est; null if it is not installed"),
    DocumentField("status", "text", "the exit code in words", _statuses),
    DocumentField("exit_code", "whole number", "exit code of the process"),
    DocumentField(
        "message", "text", "reason why the command has no result; empty if it has a result"
    ),
    DocumentField(
        "sentences", "list", "all sentences that are printed without --json, except the tables"
    ),
    DocumentField("complaints", "list", "the sentences that are printed on standard error"),
    DocumentField(
        "criteria", "list", "each --fail-if: its `expression`, whether it is `met`, and `why`"
    ),
)
"""Fields of every command, including a failed command."""

_OF_RUN = (
    DocumentField("run", "text", "folder of the run"),
    DocumentField("run_status", "text", "status of the run, as in run.json", _run_statuses),
    DocumentField("cost_before", "number", "cost at the start values"),
    DocumentField("cost", "number", "cost of the result"),
    DocumentField(
        "rmse_train",
        "number",
        "root mean square of the training errors divided by sigma; for close-loop, divided by the "
        "noise that `errors_over` in `facts` names; without a sigma, in the units of the outputs",
    ),
    DocumentField(
        "rmse_test",
        "number",
        "root mean square of the held-out errors, in the same unit as `rmse_train`",
    ),
    DocumentField(
        "verdict", "text", "verdict of the search for missing effects (close-loop)", verdicts
    ),
    DocumentField("summary", "text", "result of close-loop or design, as a sentence"),
    DocumentField("effects", "list", "names of the effects that close-loop has added"),
    DocumentField("doubts", "list", "doubts about the result, in a few words each"),
    DocumentField("too_narrow", "true or false", "whether the intervals are too narrow"),
    DocumentField("notes", "list", "sentences on the result"),
    DocumentField("iterations", "whole number", "number of iterations of the best search"),
    DocumentField("evaluations", "whole number", "number of points that were evaluated"),
    DocumentField("simulations", "whole number", "number of experiments that were simulated"),
    DocumentField("failures", "whole number", "number of simulations that failed"),
    DocumentField("seconds", "number", "duration of the run"),
    DocumentField("parameters", "object", "rows of parameters.parquet, by label"),
    DocumentField(
        "tables",
        "object",
        "rows of the other tables of the run that `show` prints, by name of the table",
    ),
    DocumentField("next", "list", "next steps: each `text`, and its `command` for a shell"),
    DocumentField("facts", "object", "contents of run.json"),
)
_WRITTEN = DocumentField("out", "text", "path that was written")

FIELDS: Mapping[str, tuple[DocumentField, ...]] = {
    "init": (
        _WRITTEN,
        DocumentField(
            "to_fill_in", "list", "lines of the config that you have to fill in: `line` and `text`"
        ),
        DocumentField("missing_inputs", "list", "inputs for which no column was found"),
    ),
    "check": (
        DocumentField("model", "object", "the model: `name`, `interface` and `solver`"),
        DocumentField(
            "variables",
            "list",
            "inputs, outputs, states and parameters of an FMU without a config: `name`, `is`, "
            "`unit`, `start`, and the description `text`",
        ),
        DocumentField("checks", "list", "each check: `verdict`, `check`, `found` and `do`"),
        DocumentField("problems", "whole number", "number of checks with the verdict `problem`"),
        DocumentField("check_notes", "whole number", "number of checks with the verdict `note`"),
        DocumentField("not_done", "whole number", "number of checks that were not done"),
        DocumentField(
            "unknowns", "whole number", "number of unknowns of a fit to the training experiments"
        ),
        DocumentField(
            "experiments",
            "list",
            "simulations at the start values: `id`, `role`, `start`, `stop`, `samples`, `status`, "
            "`message`, and the duration `seconds`",
        ),
        DocumentField(
            "constraints",
            "list",
            "constraints at the start values: `constraint`, `equality`, `value`",
        ),
    ),
    "fit": _OF_RUN,
    "close-loop": _OF_RUN,
    "sensitivity": _OF_RUN,
    "design": (
        *_OF_RUN,
        _WRITTEN,
        DocumentField("block", "text", "lines to add to the config for the next experiment"),
    ),
    "simulate": (
        _WRITTEN,
        DocumentField("rows", "whole number", "number of rows of the written table"),
        DocumentField("experiments", "list", "each experiment: `id`, `status` and `message`"),
    ),
    "show": (
        *_OF_RUN,
        DocumentField(
            "iteration_rows",
            "list",
            "with --iterations or --search: the rows of the iteration table",
        ),
        DocumentField(
            "failed", "list", "with --failures: the failed simulations, each with its `number`"
        ),
    ),
    "report": (_WRITTEN,),
    "watch": (
        DocumentField("run", "text", "folder of the run"),
        DocumentField("run_status", "text", "status of the run", _run_statuses),
        DocumentField("doing", "text", "what the run is doing"),
        DocumentField("seconds", "number", "seconds since the run began"),
        DocumentField("evaluations", "whole number", "number of points that were evaluated"),
        DocumentField("simulations", "whole number", "number of experiments that were simulated"),
        DocumentField("failures", "whole number", "number of simulations that failed"),
        DocumentField("workers", "whole number", "number of workers of the run"),
        DocumentField("busy", "whole number", "number of workers that are simulating"),
        DocumentField(
            "searches",
            "list",
            "each search: `search`, `iteration`, `evaluations`, `best`, `cost`, `ending`",
        ),
        DocumentField("failure_reasons", "list", "each reason: `count`, `status` and `message`"),
        DocumentField(
            "runs",
            "list",
            "for a folder of runs, each run: `name`, `status`, `verdict`, `cost`, `values` of the "
            "best point, `simulations`, `failed`, `seconds`, `doing`, `left` and `message`; costs "
            "of runs with the same `data` are comparable",
        ),
    ),
    "export": (DocumentField("files", "list", "files that were written"),),
    "sweep": (
        _WRITTEN,
        DocumentField("ran", "whole number", "number of runs that this call has done"),
        DocumentField("runs", "list", "rows of summary.parquet"),
        DocumentField("counts", "object", "number of runs for each status"),
        DocumentField("verdicts", "object", "number of close-loop runs for each verdict"),
        DocumentField("doubtful", "whole number", "number of runs with a doubtful solution"),
        DocumentField("worst_rmse_train", "number", "the largest `rmse_train` of the runs"),
        DocumentField("worst_rmse_test", "number", "the largest `rmse_test` of the runs"),
    ),
    "replay": (
        DocumentField(
            "logged",
            "object",
            "the logged simulation: `number`, `experiment`, `search`, `purpose`, `effects`",
        ),
        DocumentField("values", "object", "by parameter"),
        DocumentField("then", "object", "result in the log: `status`, `message` and `cost`"),
        DocumentField("now", "object", "result of the repeated simulation, with the same fields"),
        DocumentField(
            "same_inputs",
            "true or false",
            "whether model, data and effects are the same as in the run",
        ),
    ),
    "forms": (DocumentField("forms", "list", "each form at each kind of site"),),
}
"""The fields of each command in addition to `COMMON_FIELDS`."""


def fields_of(command: str) -> dict[str, DocumentField]:
    """Return the fields of a command's document by name."""
    return {each.name: each for each in (*COMMON_FIELDS, *FIELDS[command])}


def status_of(code: int) -> str:
    """Return an exit code in words."""
    return ExitCode(code).name.lower().replace("_", " ")


def document_of(command: str | None, answer: Answer, code: int) -> dict[str, Any]:
    """Return the document of a finished command, with all of its fields in their order.

    `command` is None if it could not be determined.
    """
    found = {name: plain(value) for name, value in answer.found.items()}
    head = {
        "command": command,
        "version": program_version(),
        "status": status_of(code),
        "exit_code": int(code),
        "message": "",
        "sentences": answer.sentences,
        "complaints": answer.complaints,
        "criteria": [],
    }
    if command is None or command not in FIELDS:
        return head | found
    unknown = found.keys() - fields_of(command).keys()
    if unknown:
        raise KeyError(f"{command} has no field {', '.join(unknown)}; declare it here")
    return head | {each.name: found.get(each.name) for each in FIELDS[command]} | found


def as_text(document: Mapping[str, Any]) -> str:
    """Return a document as one line of JSON in ASCII."""
    return json.dumps(document, allow_nan=False)


def program_version() -> str | None:
    """Return the version of cluster-est; None if it is not installed."""
    try:
        return version("cluster-est")
    except PackageNotFoundError:
        return None


def plain(value: Any) -> Any:
    """Return a value with types of JSON; None for a number that is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, str | PurePath):
        return str(value)
    if isinstance(value, Sequence):
        return [plain(item) for item in value]
    if value is None or isinstance(value, bool | int):
        return value
    if hasattr(value, "tolist"):  # NumPy
        return plain(value.tolist())
    number = float(value)
    return number if math.isfinite(number) else None


def run_fields(run: StoredRun) -> dict[str, Any]:
    """Return the fields of a run of any kind; `run` has the tables that are printed."""
    facts, tables = run.facts, dict(run.tables)
    rmse = facts.get("rmse_over_sigma") or {}
    if facts.get("verdict"):
        rmse = {role: both["after"] for role, both in facts["errors"].items()}
    same = (
        "cost_before", "cost", "verdict", "doubts", "notes", "iterations", "evaluations",
        "simulations", "failures", "seconds",
    )  # fmt: skip
    return {name: facts.get(name) for name in same} | {
        "run": run.path,
        "run_status": facts["status"],
        "rmse_train": rmse.get("train"),
        "rmse_test": rmse.get("test"),
        "summary": facts.get("summary") or (facts.get("design") or {}).get("summary"),
        "effects": [each["name"] for each in facts.get("effects") or ()],
        "too_narrow": (facts.get("residuals") or {}).get("too_narrow"),
        "parameters": {row["label"]: row for row in tables.pop("parameters", ())},
        "tables": {name: rows for name, rows in tables.items() if rows},
        "facts": facts,
    }
