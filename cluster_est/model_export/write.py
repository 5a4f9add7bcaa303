"""Export of a run: read it, then write each requested form."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import sympy as sp
from sympy.printing.precedence import precedence
from sympy.printing.str import StrPrinter

from cluster_est.errors import ConfigError
from cluster_est.model_export.fmi2_description import as_document
from cluster_est.model_export.repaired_fmu import write_fmu
from cluster_est.model_export.repaired_model import (
    EstimatedValue,
    RepairedModel,
    describe_repair,
    gather,
)
from cluster_est.whole_files import ELSEWHERE, write_whole
from workers.core.assemble import TIME_SYMBOL
from workers.effects.definition import SIGNAL_SYMBOL, EffectDefinition, variable_symbol
from workers.messages import Value

_NO_FUNCTION = {
    "backlash": "the play operator is not a function of Modelica; see Modelica.Blocks",
    **dict.fromkeys(
        ("rate_limit", "rate_limit_from_rest"),
        "this is not a function of Modelica; see Modelica.Blocks.Nonlinear.SlewRateLimiter",
    ),
}
_FUNCTION_NAMES = {"Abs": "abs", "sign": "sign", "Min": "min", "Max": "max", "sqrt": "sqrt"}


class _ModelicaPrinter(StrPrinter):  # type: ignore[misc]
    """Prints expressions of Modelica."""

    def _print_Pow(self, expr: sp.Expr) -> str:  # noqa: N802 - SymPy's name
        base, exponent = expr.args
        if exponent == sp.Rational(1, 2):
            return f"sqrt({self._print(base)})"
        if exponent == -1:
            return f"1/{self.parenthesize(base, precedence(expr))}"
        power = precedence(expr)
        return f"{self.parenthesize(base, power + 1)}^{self.parenthesize(exponent, power + 1)}"

    def _print_Function(self, expr: sp.Expr) -> str:  # noqa: N802
        name = type(expr).__name__
        arguments = [self._print(argument) for argument in expr.args]
        return f"{_FUNCTION_NAMES.get(name, name)}({', '.join(arguments)})"

    def _print_Min(self, expr: sp.Expr) -> str:  # noqa: N802
        return self._nested("min", expr)

    def _print_Max(self, expr: sp.Expr) -> str:  # noqa: N802
        return self._nested("max", expr)

    def _nested(self, name: str, expr: sp.Expr) -> str:
        """Print nested calls, because Modelica's min and max take two numbers."""
        first, *rest = (str(self._print(argument)) for argument in expr.args)
        for argument in rest:
            first = f"{name}({first}, {argument})"
        return first

    def _print_Piecewise(self, expr: sp.Expr) -> str:  # noqa: N802
        *chosen, (last, _) = expr.args
        arms = [f"if {self._print(when)} then {self._print(value)} else " for value, when in chosen]
        return f"({''.join(arms)}{self._print(last)})"

    def _print_Relational(self, expr: sp.Expr) -> str:  # noqa: N802
        left, right = (self._print(side) for side in (expr.lhs, expr.rhs))
        return f"{left} {expr.rel_op} {right}"

    def _print_Rational(self, expr: sp.Rational) -> str:  # noqa: N802
        return f"{expr.p}/{expr.q}"


def modelica(repair: RepairedModel) -> str:
    """Return the effects as declarations and equations, and the parameters as modifiers."""
    lines = [f"// {repair.description.file} with the results of run {repair.run}"]
    if repair.parameters:
        lines.append("// parameters and initial states of the model:")
        lines += [f"//   {f.name} = {f.value!r}{_comment(f)}" for f in repair.parameters]
    if not repair.effects:
        return "\n".join([*lines, "// no effects were added", ""])
    declared, equations = [], []
    for effect, values in zip(repair.effects, repair.coefficients, strict=True):
        declared += [*_declarations(effect, values)]
        equations += [f"  // {effect.form.name} at {effect.site}", *_equations(effect)]
    return "\n".join([*lines, *declared, "equation", *equations, ""])


def _comment(found: EstimatedValue) -> str:
    unit = f" [{found.unit}]" if found.unit else ""
    return unit + (f", {found.interval}" if found.interval else "")


def _name(*parts: str) -> str:
    """Return an identifier of Modelica."""
    return re.sub(r"\W+", "_", "_".join(parts)).strip("_")


def _declarations(effect: EffectDefinition, values: tuple[EstimatedValue, ...]) -> Iterator[str]:
    for value in values:
        unit = f'(unit="{value.unit}")' if value.unit else ""
        said = f' "{value.interval}"' if value.interval else ""
        yield f"  parameter Real {_name(value.name)}{unit} = {value.value!r}{said};"
    for state in effect.form.states:
        yield f'  Real {_name(effect.effect.name, state.name)} "state of {effect.form.name}";'
    for target in effect.site.targets:
        yield f"  Real {_result(effect, target)};"


def _result(effect: EffectDefinition, target: str) -> str:
    return _name(effect.effect.name, "at", target)


def _equations(effect: EffectDefinition) -> Iterator[str]:
    name = effect.effect.name
    meaning = {s: sp.Symbol(_name(str(s))) for s in effect.coefficients}
    pairs = zip(effect.states, effect.form.states, strict=True)
    meaning |= {symbol: sp.Symbol(_name(name, own.name)) for symbol, own in pairs}
    meaning |= {variable_symbol(used): sp.Symbol(used) for used in effect.uses}
    meaning |= {TIME_SYMBOL: sp.Symbol("time"), SIGNAL_SYMBOL: sp.Symbol(effect.site.target)}

    def text(expression: sp.Expr) -> str:
        return str(_ModelicaPrinter().doprint(expression.xreplace(meaning)))

    for target, equation in effect.equations:
        result, site = _result(effect, target), effect.site
        if effect.form.memory:
            size = _name(str(effect.coefficients[0]))
            if effect.form.memory == "delay":
                yield f"  {result} = delay({target}, {size});"
            else:
                yield f"  {result} = {effect.form.memory}({target}, {size});"
                yield f"  // {_NO_FUNCTION[effect.form.memory]}"
        else:
            yield f"  {result} = {text(equation)};"
        if site.at_rates:
            yield f"  // add {result} to the right side of der({target})"
        else:
            yield f"  // replace {target} by {result}"
    for own, slope in zip(effect.form.states, effect.derivatives, strict=True):
        yield f"  der({_name(name, own.name)}) = {text(slope)};"
    starts = zip(effect.form.states, effect.starts, strict=True)
    for own, start in starts:
        yield f"  // initial equation: {_name(name, own.name)} = {text(start)};"


VALUES = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
COMMON = "http://ssp-standard.org/SSP1/SystemStructureCommon"


def parameter_set(repair: RepairedModel) -> bytes:
    """Return an SSP parameter set with estimates, known values, and coefficients of the effects.

    Each unit has a name and an empty base unit, because the run does not know its definition.
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
    return as_document(root)


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
"""Columns of the table; `low` and `high` are the 95 % interval, empty if unknown."""


def value_table(repair: RepairedModel) -> bytes:
    """Return a table of estimates, coefficients of the effects, and known values."""
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
    """Requested forms of export: files to write, and texts to print.

    `measure` is whether the communication step of the FMU is measured.
    """

    fmu: Path | None = None
    ssv: Path | None = None
    csv: Path | None = None
    modelica: bool = False
    text: bool = False
    measure: bool = True


@dataclass(frozen=True)
class ExportResult:
    """Written files, texts to print, and notes for the user."""

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
    """Write the results of a run.

    Parameters
    ----------
    run_folder, config, experiment, allow_code
        See `cluster_est.model_export.repaired_model.gather`.
    wanted
        At least one form.

    Raises
    ------
    ClusterEstError
        If no form is requested, the run cannot be read, or a file cannot be written.
    """
    check_request(wanted)
    return write_forms(gather(run_folder, config, experiment, allow_code=allow_code), wanted)


def check_request(wanted: ExportRequest) -> None:
    """Refuse a request for no form, or for files with wrong suffixes.

    Raises
    ------
    ConfigError
        With the possible forms.
    """
    if not (wanted.fmu or wanted.ssv or wanted.csv or wanted.modelica or wanted.text):
        raise ConfigError(
            "export: needs an output to write; add --fmu, --ssv, --csv, --modelica or --text"
        )
    _check_name(wanted.fmu, "--fmu", ".fmu")
    _check_name(wanted.ssv, "--ssv", ".ssv")
    _check_name(wanted.csv, "--csv", ".csv")


def write_forms(repair: RepairedModel, wanted: ExportRequest) -> ExportResult:
    """Write all requested forms.

    Raises
    ------
    ClusterEstError
        If a file cannot be written.
    """
    _check_not_original(wanted.fmu, repair.problem.model.archive_hash)
    notes, files, printed = list(repair.notes), [], []
    if wanted.fmu is not None:
        notes += write_fmu(repair, wanted.fmu, measure=wanted.measure)
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
    """Refuse to overwrite the original, which later exports need."""
    if path is None or not path.is_file():
        return
    if hashlib.sha256(path.read_bytes()).hexdigest() == original:
        raise ConfigError(
            f"--fmu: must differ from the original FMU, but is {path}; choose another name"
        )


def _check_name(path: Path | None, option: str, suffix: str) -> None:
    if path is None:
        return
    if path.suffix.lower() != suffix:
        raise ConfigError(f"{option}: must end in {suffix}, but is {path.name!r}; rename it")
    if not path.parent.is_dir():
        raise ConfigError(
            f"{option}: must be in an existing folder, but {path.parent} does not exist; make it, "
            "or choose another folder"
        )
    if path.is_dir():
        raise ConfigError(f"{option}: must be a file, but {path} is a folder; choose another name")
