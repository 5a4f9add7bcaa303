"""The model description of an FMU: its variables, interfaces and structure.

`fmpy.read_model_description` is not used, because it refuses a description with any fault, and many
exported descriptions have a harmless fault. Of 125 faulty descriptions that are read here with at
most a warning, it reads 26, and 84 without validation. The others end in a KeyError, TypeError,
IndexError, AttributeError, UnboundLocalError or XMLSyntaxError, which do not help an author.
Examples are a reference without a variable, an unknown type, a missing ModelVariables, an
undeclared XML prefix, and FMI 3.1. It accepts a model identifier that leads out of the archive.
Without validation, it accepts a model without a guid, or a state whose derivative is listed twice.
"""

from __future__ import annotations

import difflib
import re
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

from workers.errors import ModelError
from workers.fmu.archive import DAMAGED, open_archive
from workers.fmu.model_variables import read_variables
from workers.fmu.platforms import missing_binary, platforms_in
from workers.fmu.structure import InterfaceOffer, VariableDependency, read_offers, read_structure
from workers.fmu.variable import ModelVariable
from workers.fmu.xml import (
    XML,
    ReadingNotes,
    UnitDefinition,
    Version,
    first_line,
    flag,
    number,
    parse,
    read_units,
)
from workers.messages import Interface, Model


@dataclass(frozen=True)
class ModelDescription:
    """The model description of an FMU.

    Attributes
    ----------
    file
        Name of the file, for messages.
    version
        Version of FMI.
    guid
        Identifier that is required to instantiate the FMU; in FMI 3, the instantiation token.
    tool
        Tool that exported the FMU; "" if unknown.
    offers
        The usable interfaces. An interface with an unusable description is omitted, with a warning.
    variables
        Variables by name. An array x of FMI 3 is represented by its elements, "x[1]" or "x[2,1]".
    states
        Names of the continuous states, in the order of the FMU's state vector.
    outputs
        Names of the outputs, in the order of the FMU's own list.
    dependencies
        Dependencies of outputs and state derivatives.
    files
        Names of binaries and sources in the archive.
    interpolates_inputs, variable_steps, has_event_mode, fixed_internal_step
        Capabilities of the co-simulation interface. The last is in seconds; None if not declared.
    completes_steps
        Whether the model exchange interface must be notified of each completed step.
    once_per_process
        Whether any interface can be instantiated only once in a process.
    default_start, default_stop, default_step, default_tolerance
        Seconds, and a relative tolerance; None if not declared.
    warnings
        A sentence for each tolerated fault.
    units
        Definitions by name of the units that the FMU defines by base units.
    """

    file: str
    version: Version
    guid: str
    tool: str
    offers: tuple[InterfaceOffer, ...]
    variables: dict[str, ModelVariable]
    states: tuple[str, ...]
    event_indicators: int
    outputs: tuple[str, ...]
    dependencies: tuple[VariableDependency, ...]
    files: tuple[str, ...]
    interpolates_inputs: bool
    variable_steps: bool
    has_event_mode: bool
    fixed_internal_step: float | None
    completes_steps: bool
    once_per_process: bool
    default_start: float | None
    default_stop: float | None
    default_step: float | None
    default_tolerance: float | None
    warnings: tuple[str, ...]
    units: Mapping[str, UnitDefinition] = field(default_factory=dict)

    @property
    def interfaces(self) -> tuple[Interface, ...]:
        return tuple(offer.interface for offer in self.offers)

    @property
    def platforms(self) -> tuple[str, ...]:
        """Platforms with a folder of binaries, by the names of the folders."""
        return platforms_in(self.files)

    @property
    def has_sources(self) -> bool:
        return any(name.startswith("sources/") and name.endswith(".c") for name in self.files)

    def offer(self, interface: Interface) -> InterfaceOffer:
        """Return the capabilities of an interface."""
        return next(offer for offer in self.offers if offer.interface == interface)

    def variable(self, name: str, where: str) -> ModelVariable:
        """Return a variable by name; `where` is the start of the message if there is none."""
        if name not in self.variables:
            first = next((n for n in self.variables if n.startswith(f"{name}[")), None)
            ending = nearest(name, self.variables)
            if first is not None:
                ending = (
                    f", but has an array of that name; name one of its elements, such as {first!r}"
                )
            raise ModelError(f"{where}: {self.file} has no variable {name!r}{ending}")
        return self.variables[name]

    def holds(self, name: str) -> bool:
        """Return whether an input changes only at events, so it is held between samples."""
        variable = self.variables.get(name)
        return variable is not None and not variable.is_continuous

    def unit_of(self, name: str) -> str:
        """Return the unit of a variable; "" if the FMU has no such variable."""
        variable = self.variables.get(name)
        return "" if variable is None else variable.unit

    def inputs(self) -> list[ModelVariable]:
        """Return the inputs, without aliases."""
        inputs = (v for v in self.variables.values() if v.causality == "input")
        return [v for v in inputs if v.alias_of is None]

    def check_platform(self, interface: Interface) -> None:
        """Check that the FMU has a binary for this machine.

        Raises
        ------
        ModelError
            If it has none. The message names the available platforms and gives advice.
        """
        identifier = self.offer(interface).identifier
        fault = missing_binary(self.version, identifier, self.files, self.has_sources)
        if fault is not None:
            raise ModelError(f"{self.file}: {fault}")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the end of a message: the known name closest to a misspelt one, or all names."""
    names = [str(k) for k in known]
    lowered = {k.lower(): k for k in names}
    close = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {lowered[close[0]]!r}?"
    if not names:
        return "; there are none to choose from"
    listed = ", ".join(repr(k) for k in names[:12])
    return f"; available: {listed}" + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def describe(
    file: str, archive: bytes, structural: Mapping[str, int] | None = None
) -> ModelDescription:
    """Read the model description of an FMU.

    Harmless faults are tolerated and listed in `ModelDescription.warnings`.

    Parameters
    ----------
    structural
        Values of structural parameters (FMI 3) that differ from their start values. They determine
        the sizes of arrays.

    Raises
    ------
    ModelError
        If the archive or its model description cannot be read or used, or is of another FMI
        version, or has no such structural parameter.
    """
    notes = ReadingNotes(file)
    with open_archive(file, archive) as archive_file:
        names = archive_file.namelist()
        root = parse(file, _content(file, archive_file), notes)
    version = _version(root, notes)
    declared = read_variables(root, version, structural or {}, notes)
    _check_structural(file, declared.variables, structural or {})
    structure = read_structure(root, version, declared, notes)
    units = read_units(root, notes)
    offers = read_offers(root, structure.fault, notes)
    exchange, simulation, default_experiment = (
        _section(root, tag) for tag in ("ModelExchange", "CoSimulation", "DefaultExperiment")
    )
    if version == "2.0":
        completes_steps = not flag(exchange.get("completedIntegratorStepNotNeeded"))
    else:
        completes_steps = flag(exchange.get("needsCompletedIntegratorStep"))
    offered = [offer.interface for offer in offers]
    guid = root.get("instantiationToken") or root.get("guid")
    if not guid:
        key = "guid" if version == "2.0" else "instantiationToken"
        raise ModelError(f"{file}: its {XML} must have a {key}, but has none; export it again")
    return ModelDescription(
        file=file,
        version=version,
        guid=guid,
        tool=" ".join((root.get("generationTool") or "").split()),
        offers=offers,
        variables=declared.variables,
        states=structure.states,
        event_indicators=structure.event_indicators,
        outputs=structure.outputs,
        dependencies=structure.dependencies,
        files=tuple(n for n in names if n.startswith(("binaries/", "sources/"))),
        interpolates_inputs=version == "2.0" and flag(simulation.get("canInterpolateInputs")),
        variable_steps="co_simulation" not in offered
        or flag(simulation.get("canHandleVariableCommunicationStepSize")),
        has_event_mode=version == "3.0" and flag(simulation.get("hasEventMode")),
        fixed_internal_step=_setting(simulation, "fixedInternalStepSize", notes),
        completes_steps="model_exchange" in offered and completes_steps,
        once_per_process=any(offer.once_per_process for offer in offers),
        default_start=_setting(default_experiment, "startTime", notes),
        default_stop=_setting(default_experiment, "stopTime", notes),
        default_step=_setting(default_experiment, "stepSize", notes),
        default_tolerance=_setting(default_experiment, "tolerance", notes),
        warnings=notes.messages(),
        units=units,
    )


def describe_model(model: Model) -> ModelDescription:
    """Read the model description of a worker's model."""
    return describe(model.name, model.archive, dict(model.structure))


def _content(file: str, archive_file: zipfile.ZipFile) -> bytes:
    if XML not in archive_file.namelist():
        raise ModelError(
            f"{file}: must contain a {XML}, but does not, so it is not an FMU; export the model as "
            "an FMU"
        )
    try:
        return archive_file.read(XML)
    except (*DAMAGED, OSError) as error:
        raise ModelError(
            f"{file}: its {XML} must be XML, but cannot be read ({first_line(error)}); export it "
            "again"
        ) from error


def _version(root: Element, notes: ReadingNotes) -> Version:
    if root.tag != "fmiModelDescription":
        raise ModelError(
            f"{notes.file}: its {XML} must describe a model, with <fmiModelDescription>, but "
            f"describes <{root.tag}>; export the model as an FMU"
        )
    text = " ".join((root.get("fmiVersion") or "").split())
    known = re.fullmatch(r"(2\.0|3\.[0-9]{1,3})(\.[0-9]{1,3})?", text)
    if known is None:
        has = f"is of {text[:40]}" if text else "names no version"
        raise ModelError(
            f"{notes.file}: must be an FMU of FMI version 2.0 or 3.0, but {has}; export it in one "
            "of these versions"
        )
    version: Version = "2.0" if known.group(1) == "2.0" else "3.0"
    if known.group(1) != version:
        notes.add(f"its FMI version is {text}, which is read as {version}")
    return version


def _check_structural(
    file: str, variables: Mapping[str, ModelVariable], structural: Mapping[str, int]
) -> None:
    known = [v.name for v in variables.values() if v.causality == "structuralParameter"]
    for name, value in structural.items():
        if name not in known:
            raise ModelError(f"{file}: has no structural parameter {name!r}{nearest(name, known)}")
        if value < 0:
            raise ModelError(
                f"{file}: the structural parameter {name!r} must be a size, which is at least 0, "
                f"but is {value}; change it"
            )


def _section(root: Element, tag: str) -> Element:
    found = root.find(tag)
    return Element(tag) if found is None else found


def _setting(element: Element, key: str, notes: ReadingNotes) -> float | None:
    return number(element.get(key), notes, key, element.tag)
