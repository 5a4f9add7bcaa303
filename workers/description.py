"""What an FMU says about itself: its variables and what it can do."""

from __future__ import annotations

import difflib
import io
import math
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal
from xml.etree import ElementTree

import fmpy
from fmpy.model_description import ModelDescription, ScalarVariable, read_model_description

from workers.archive import DAMAGED, open_archive
from workers.errors import ModelError
from workers.messages import Interface

XML = "modelDescription.xml"

Kind = Literal["real", "integer", "boolean", "string"]

_KINDS: dict[str, Kind] = {
    "Real": "real",
    "Integer": "integer",
    "Enumeration": "integer",
    "Boolean": "boolean",
    "String": "string",
}


@dataclass(frozen=True)
class Variable:
    """One variable of an FMU. `start`, `low` and `high` are None where the FMU names none."""

    name: str
    reference: int
    kind: Kind
    causality: str
    settable: bool
    tunable: bool = False
    unit: str = ""
    start: float | None = None
    low: float | None = None
    high: float | None = None
    nominal: float = 1.0


@dataclass(frozen=True)
class Description:
    """What an FMU says about itself.

    Attributes
    ----------
    file
        The file's name, for messages.
    platforms
        Platforms that it has a binary for, in FMI's names ("linux64", "win64", "darwin64").
    states
        Names of the continuous states, in the order of the FMU's state vector.
    raw
        fmpy's own description, for loading.
    """

    file: str
    variables: dict[str, Variable]
    interfaces: tuple[Interface, ...]
    platforms: tuple[str, ...]
    states: tuple[str, ...]
    event_indicators: int
    interpolates_inputs: bool
    variable_steps: bool
    completes_steps: bool
    once_per_process: bool
    default_step: float | None
    raw: ModelDescription = field(repr=False)

    def variable(self, name: str, where: str) -> Variable:
        """Look up a variable; `where` opens the message if there is none of that name."""
        if name not in self.variables:
            raise ModelError(
                f"{where}: {self.file} has no variable {name!r}{nearest(name, self.variables)}"
            )
        return self.variables[name]

    def inputs(self) -> list[Variable]:
        return [v for v in self.variables.values() if v.causality == "input"]


def nearest(name: str, known: Iterable[str]) -> str:
    """The end of a sentence: which known name a misspelt one is nearest to, or which there are."""
    names = [str(k) for k in known]
    lowered = {k.lower(): k for k in names}
    close = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {lowered[close[0]]!r}?"
    if not names:
        return "; it has none at all"
    listed = ", ".join(repr(k) for k in names[:12])
    return f"; it has {listed}" + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def describe(file: str, archive: bytes) -> Description:
    """Read the model description of an FMU.

    Raises
    ------
    ModelError
        If the archive or its model description cannot be read, or is of another FMI version.
    """
    with open_archive(file, archive) as opened:
        names = opened.namelist()
        if XML not in names:
            raise ModelError(
                f"{file}: must hold a {XML} but does not, so it is no FMU; export the model as an "
                "FMU"
            )
        _check_version(file, opened)
    try:
        raw = read_model_description(io.BytesIO(archive), validate=False)
        return _describe(file, names, raw)
    except ModelError:
        raise
    except Exception as error:  # fmpy raises bare exceptions of every kind here
        raise ModelError(
            f"{file}: its {XML} must follow the FMI standard but does not "
            f"({type(error).__name__}: {_first_line(error)}); export it again"
        ) from error


def _check_version(file: str, opened: zipfile.ZipFile) -> None:
    """Look at the root alone: what follows it depends on the version."""
    try:
        with opened.open(XML) as stream:
            _, root = next(ElementTree.iterparse(stream, events=["start"]))
    except (ElementTree.ParseError, LookupError, *DAMAGED, OSError) as error:
        raise ModelError(
            f"{file}: its {XML} must be XML but cannot be read ({_first_line(error)}); export it "
            "again"
        ) from error
    if root.tag != "fmiModelDescription":
        raise ModelError(
            f"{file}: its {XML} must describe a model, as <fmiModelDescription>, but describes "
            f"<{root.tag}>; export the model as an FMU"
        )
    version = root.get("fmiVersion")
    if version != "2.0":
        has = f"is of {version}" if version else "names no version"
        raise ModelError(
            f"{file}: must be an FMU of FMI version 2.0 but {has}; export it as FMI 2.0"
        )


def _describe(file: str, names: list[str], raw: ModelDescription) -> Description:
    exchange, simulation = raw.modelExchange, raw.coSimulation
    offered: list[Interface] = []
    if exchange is not None:
        offered.append("model_exchange")
    if simulation is not None:
        offered.append("co_simulation")
    if not offered:
        raise ModelError(
            f"{file}: must offer model exchange or co-simulation but offers neither; "
            "export it with one of them"
        )
    types = [i for i in (exchange, simulation) if i is not None]
    _check_names(file, raw.guid, [t.modelIdentifier for t in types])
    binaries = {n.split("/")[1] for n in names if n.startswith("binaries/") and n.count("/") > 1}
    experiment = raw.defaultExperiment
    step = experiment.stepSize if experiment is not None else None
    return Description(
        file=file,
        variables={v.name: _variable(v) for v in raw.modelVariables},
        interfaces=tuple(offered),
        platforms=tuple(sorted(binaries)),
        states=tuple(d.variable.derivative.name for d in raw.derivatives),
        event_indicators=int(raw.numberOfEventIndicators or 0),
        interpolates_inputs=simulation is not None and bool(simulation.canInterpolateInputs),
        variable_steps=simulation is None
        or bool(simulation.canHandleVariableCommunicationStepSize),
        completes_steps=exchange is not None
        and not bool(exchange.completedIntegratorStepNotNeeded),
        once_per_process=any(bool(i.canBeInstantiatedOnlyOncePerProcess) for i in types),
        default_step=None if step is None else float(step),
        raw=raw,
    )


def _check_names(file: str, guid: str | None, identifiers: list[str | None]) -> None:
    """The names that loading needs; an identifier names a file, so it must not name a folder."""
    plain = all(i and set(i).isdisjoint("/\\") for i in identifiers)
    if not guid or not plain:
        key, has = ("guid", guid) if plain else ("plain modelIdentifier", identifiers)
        raise ModelError(f"{file}: its {XML} must have a {key} but has {has}; export it again")


def _variable(raw: ScalarVariable) -> Variable:
    declared = raw.declaredType
    return Variable(
        name=raw.name,
        reference=int(raw.valueReference),
        kind=_KINDS[raw.type],
        causality=raw.causality or "local",
        settable=_settable(raw),
        tunable=raw.causality == "parameter" and raw.variability == "tunable",
        unit=raw.unit or (declared.unit if declared is not None else None) or "",
        start=_number(raw.start),
        low=_number(raw.min if raw.min is not None else getattr(declared, "min", None)),
        high=_number(raw.max if raw.max is not None else getattr(declared, "max", None)),
        nominal=abs(_number(raw.nominal) or 1.0),
    )


def _settable(raw: ScalarVariable) -> bool:
    """Whether FMI 2.0 allows a start value to be set before initialisation."""
    if raw.variability == "constant" or raw.causality in ("calculatedParameter", "independent"):
        return False
    if raw.causality in ("parameter", "input"):
        return True
    return raw.initial in ("exact", "approx") or (raw.initial is None and raw.start is not None)


def _number(text: object) -> float | None:
    try:
        number = float(str(text))
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


PLATFORM: str = fmpy.platform
"""This machine's platform in FMI 2.0's names."""
