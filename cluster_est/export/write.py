"""The recipe of an export: gather, then write each form that is asked for."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from cluster_est.errors import ConfigError
from cluster_est.export.modelica import modelica
from cluster_est.export.repair import gather
from cluster_est.export.repaired_fmu.compiler import PLATFORMS
from cluster_est.export.repaired_fmu.fmu import FmuOptions, write_fmu
from cluster_est.export.repaired_model import EstimatedValue, RepairedModel, describe_repair
from cluster_est.whole_files import ELSEWHERE, write_whole
from workers.fmu.description import nearest
from workers.messages import Value

VALUES = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
COMMON = "http://ssp-standard.org/SSP1/SystemStructureCommon"


def parameter_set(repair: RepairedModel) -> bytes:
    """The document: estimates, known values, and the coefficients of the effects.

    Each unit has a name and an empty base unit: what it is made of, the run does not know.
    """
    ET.register_namespace("ssv", VALUES)
    ET.register_namespace("ssc", COMMON)
    root = Element(f"{{{VALUES}}}ParameterSet", version="1.0", name=f"estimates of {repair.run}")
    parameters = SubElement(root, f"{{{VALUES}}}Parameters")
    found = [*repair.parameters, *(value for own in repair.coefficients for value in own)]
    for each in found:
        _add(parameters, each.name, float(each.value), each.unit)
    for name, value in repair.known:
        variable = repair.description.variables[name]
        given = float(value) if variable.kind == "real" else value
        _add(parameters, name, given, variable.unit)
    named = {each.unit for each in found}
    named |= {repair.description.variables[name].unit for name, _ in repair.known}
    if units := sorted(named - {""}):
        section = SubElement(root, f"{{{VALUES}}}Units")
        for name in units:
            unit = SubElement(section, f"{{{COMMON}}}Unit", name=name)
            SubElement(unit, f"{{{COMMON}}}BaseUnit")
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def _add(parent: Element, name: str, value: Value, unit: str) -> None:
    parameter = SubElement(parent, f"{{{VALUES}}}Parameter", name=name)
    if isinstance(value, bool):
        SubElement(parameter, f"{{{VALUES}}}Boolean", value=str(value).lower())
    elif isinstance(value, str):
        SubElement(parameter, f"{{{VALUES}}}String", value=value)
    elif isinstance(value, int):
        SubElement(parameter, f"{{{VALUES}}}Integer", value=str(value))
    else:
        given = {"value": repr(value), **({"unit": unit} if unit else {})}
        SubElement(parameter, f"{{{VALUES}}}Real", given)


COLUMNS = ("name", "value", "unit", "low", "high")
"""`low` and `high` are the 95 % interval, empty where there is none."""


def value_table(repair: RepairedModel) -> bytes:
    """The document: estimates, coefficients of the effects, and known values."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(COLUMNS)
    for each in [*repair.parameters, *(value for own in repair.coefficients for value in own)]:
        rows.writerow([each.name, repr(float(each.value)), each.unit, *_interval(each)])
    for name, value in repair.known:
        shown = str(value).lower() if isinstance(value, bool) else value
        rows.writerow([name, shown, repair.description.variables[name].unit, "", ""])
    return text.getvalue().encode("utf-8")


def _interval(value: EstimatedValue) -> tuple[str, str]:
    low, high = value.low, value.high
    return ("", "") if math.isnan(low) else (repr(float(low)), repr(float(high)))


@dataclass(frozen=True)
class ExportRequest:
    """Forms of export that are asked for: files to write, and texts to print.

    `options` are those of the FMU.
    """

    fmu: Path | None = None
    ssv: Path | None = None
    csv: Path | None = None
    modelica: bool = False
    text: bool = False
    options: FmuOptions = field(default_factory=FmuOptions)


@dataclass(frozen=True)
class ExportResult:
    """Files that were written, texts to print, and notes for a user."""

    files: tuple[Path, ...]
    printed: tuple[str, ...]
    notes: tuple[str, ...]


def export(
    run_folder: Path,
    config: Path | None,
    experiment: str | None,
    wanted: ExportRequest,
    *,
    allow_code: bool = False,
) -> ExportResult:
    """Write what a run has found.

    Parameters
    ----------
    run_folder, config, experiment, allow_code
        See `cluster_est.export.repair.gather`.
    wanted
        At least one form.

    Raises
    ------
    ClusterEstError
        If nothing is asked for, the run cannot be read, or a file cannot be written.
    """
    check_request(wanted)
    return write_forms(gather(run_folder, config, experiment, allow_code=allow_code), wanted)


def check_request(wanted: ExportRequest) -> None:
    """Refuse a request for nothing, or for files of another ending.

    Raises
    ------
    ConfigError
        Saying what can be asked for.
    """
    if not (wanted.fmu or wanted.ssv or wanted.csv or wanted.modelica or wanted.text):
        raise ConfigError(
            "export: must be told what to write; add --fmu, --ssv, --csv, --modelica or --text"
        )
    for platform in wanted.options.platforms:
        if platform not in PLATFORMS:
            raise ConfigError(
                f"--platforms: must be of {', '.join(PLATFORMS)} but is {platform!r}"
                f"{nearest(platform, PLATFORMS)}"
            )
    _check_name(wanted.fmu, "--fmu", ".fmu")
    _check_name(wanted.ssv, "--ssv", ".ssv")
    _check_name(wanted.csv, "--csv", ".csv")


def write_forms(repair: RepairedModel, wanted: ExportRequest) -> ExportResult:
    """Write every form that is wanted.

    Raises
    ------
    ClusterEstError
        If a file cannot be written.
    """
    _check_not_original(wanted.fmu, repair.problem.model.archive_hash)
    notes, files, printed = list(repair.notes), [], []
    if wanted.fmu is not None:
        notes += write_fmu(repair, wanted.fmu, wanted.options)
        files.append(wanted.fmu)
    for path, option, document in (
        (wanted.ssv, "--ssv", parameter_set),
        (wanted.csv, "--csv", value_table),
    ):
        if path is not None:
            _write(path, option, document(repair))
            files.append(path)
    if wanted.modelica:
        printed.append(modelica(repair))
    if wanted.text:
        printed.append(describe_repair(repair))
    return ExportResult(tuple(files), tuple(printed), tuple(notes))


def _write(path: Path, option: str, document: bytes) -> None:
    write_whole(path, document, f"{ELSEWHERE} {option}", shared=True)


def _check_not_original(path: Path | None, original: str) -> None:
    """The original is inside nothing else, and the run cannot be exported again without it."""
    if path is None or not path.is_file():
        return
    if hashlib.sha256(path.read_bytes()).hexdigest() == original:
        raise ConfigError(
            f"--fmu: must be another file than the original FMU but is {path}; choose another name"
        )


def _check_name(path: Path | None, option: str, suffix: str) -> None:
    if path is None:
        return
    if path.suffix.lower() != suffix:
        raise ConfigError(f"{option}: must end in {suffix} but is {path.name!r}; rename it")
    if not path.parent.is_dir():
        raise ConfigError(
            f"{option}: must be in a folder that exists but {path.parent} does not; make it, or "
            "choose another"
        )
    if path.is_dir():
        raise ConfigError(f"{option}: {path} must be a file but is a folder; choose another")
