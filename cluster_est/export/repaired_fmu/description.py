"""modelDescription.xml of the exported FMU: that of the original, with what the effects add."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from xml.etree.ElementTree import Element, SubElement

from cluster_est.export.repaired_fmu.fmi3_document import as_fmi_2
from cluster_est.export.repaired_fmu.layout import AddedVariable, WrapperLayout
from workers.fmu.archive import open_archive
from workers.fmu.parsing.xml import XML, ReadingNotes, parse
from workers.messages import Value

_FLAGS = (
    "needsExecutionTool",
    "canBeInstantiatedOnlyOncePerProcess",
    "canNotUseMemoryManagementFunctions",
    "canGetAndSetFMUstate",
    "canSerializeFMUstate",
)


def identifier(layout: WrapperLayout) -> str:
    """Return the name of the exported FMU's library."""
    interface = layout.repair.problem.model.interface
    return f"{layout.repair.description.offer(interface).identifier}_repaired"


def model_description(
    layout: WrapperLayout, guid: str, sources: tuple[str, ...], tool: str
) -> bytes:
    """The document.

    Parameters
    ----------
    layout
        The exported FMU.
    guid, tool
        Of the exported FMU, and what made it.
    sources
        Names of its C files.
    """
    model = layout.repair.problem.model
    with open_archive(model.name, model.archive) as opened:
        root = parse(model.name, opened.read(XML), ReadingNotes(model.name))
    if layout.repair.description.version == "3.0":
        root = as_fmi_2(root, layout.repair.description)
    old = {tag: root.find(tag) for tag in ("ModelExchange", "CoSimulation")}
    chosen = old["ModelExchange" if layout.exchange else "CoSimulation"]
    assert chosen is not None  # the run has used it
    root.set("guid", guid)
    root.set("modelName", f"{root.get('modelName', '')}_repaired")
    root.set("generationTool", tool)
    root.attrib.pop("generationDateAndTime", None)
    what = root.get("description")
    repaired = f"with the estimates and effects of run {layout.repair.run}"
    root.set("description", f"{what} ({repaired})" if what else repaired)
    for element in old.values():
        if element is not None:
            root.remove(element)
    for place, section in enumerate(_interfaces(layout, chosen, sources)):
        root.insert(place, section)
    _add_units(root, layout)
    if layout.exchange:
        _default_experiment(root).set("tolerance", f"{layout.tolerance:g}")
    _set_starts(root, layout)
    indices = _add_variables(root, layout)
    _extend_structure(root, layout, indices)
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def with_step(document: bytes, step: float) -> bytes:
    """Return the document with a default step size, which many tools take unless told otherwise."""
    root = ET.fromstring(document)
    _default_experiment(root).set("stepSize", repr(step))
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def _default_experiment(root: Element) -> Element:
    before = (
        "ModelExchange",
        "CoSimulation",
        "UnitDefinitions",
        "TypeDefinitions",
        "LogCategories",
    )
    return _child(root, "DefaultExperiment", before)


def _interfaces(layout: WrapperLayout, old: Element, sources: tuple[str, ...]) -> list[Element]:
    kept = {flag: old.get(flag, "false") for flag in _FLAGS}
    kept = {flag: text for flag, text in kept.items() if text in ("true", "1")}
    kept = {"modelIdentifier": identifier(layout), **kept}
    if not layout.repair.effects and old.get("providesDirectionalDerivative") in ("true", "1"):
        kept["providesDirectionalDerivative"] = "true"
    simulation = Element("CoSimulation", kept)
    simulation.set("canInterpolateInputs", "true")
    varies = layout.exchange or old.get("canHandleVariableCommunicationStepSize") in ("true", "1")
    simulation.set("canHandleVariableCommunicationStepSize", str(varies).lower())
    made = [simulation]
    if layout.exchange:
        exchange = Element("ModelExchange", kept)
        delays = any(e.form.memory for e in layout.repair.effects)
        unneeded = old.get("completedIntegratorStepNotNeeded") in ("true", "1") and not delays
        exchange.set("completedIntegratorStepNotNeeded", str(unneeded).lower())
        made.insert(0, exchange)
    for element in made:
        files = SubElement(element, "SourceFiles")
        for name in sources:
            SubElement(files, "File", name=name)
    return made


def _child(root: Element, tag: str, after: tuple[str, ...]) -> Element:
    """A section of the document, made in its place if there is none."""
    found = root.find(tag)
    if found is None:
        found = Element(tag)
        places = [i for i, child in enumerate(root) if child.tag in after]
        root.insert(max(places, default=-1) + 1, found)
    return found


def _add_units(root: Element, layout: WrapperLayout) -> None:
    values = [added.value for added in layout.added if added.value is not None]
    missing = {value.unit for value in values if value.unit}
    units = root.find("UnitDefinitions")
    if units is not None:
        missing -= {unit.get("name", "") for unit in units}
    if missing:
        units = _child(root, "UnitDefinitions", ("ModelExchange", "CoSimulation"))
        for name in sorted(missing):
            SubElement(units, "Unit", name=name)


def _set_starts(root: Element, layout: WrapperLayout) -> None:
    """Estimates become the start values; of several names of a value, that which has a start."""
    description = layout.repair.description
    found = {description.variables[f.name].reference: f.value for f in layout.repair.parameters}
    known = dict(layout.repair.known)
    for scalar in root.iter("ScalarVariable"):
        name = scalar.get("name", "")
        value = scalar[0] if len(scalar) else None
        value = next((c for c in scalar if c.tag != "Annotations"), value)
        if value is None or (value.get("start") is None and name not in known):
            continue
        reference = int(scalar.get("valueReference", "-1"))
        if value.tag == "Real" and reference in found:
            value.set("start", repr(float(found[reference])))
        elif name in known:
            value.set("start", _text(value.tag, known[name]))


def _text(tag: str, given: Value) -> str:
    """A value as XML schema types have it."""
    if tag == "Boolean":
        return str(bool(given)).lower()
    return str(int(given)) if tag in ("Integer", "Enumeration") else str(given)


def _add_variables(root: Element, layout: WrapperLayout) -> dict[str, int]:
    """Append what the original does not have. Returns the index of each, which counts from 1."""
    variables = root.find("ModelVariables")
    assert variables is not None
    names = {v.get("name", "") for v in variables}
    indices: dict[str, int] = {}
    for added in layout.added:
        name = added.name if added.name not in names else f"effect {added.name}"
        indices[added.name] = len(variables) + 1
        scalar = SubElement(variables, "ScalarVariable", name=name)
        scalar.set("valueReference", str(added.reference))
        scalar.set("description", added.description)
        real = SubElement(scalar, "Real")
        _describe(added, scalar, real)
        if added.state:
            real.set("derivative", str(indices[added.state]))
    return indices


def _describe(added: AddedVariable, scalar: Element, real: Element) -> None:
    if added.kind == "COEFFICIENT":
        assert added.value is not None
        scalar.attrib.update(causality="parameter", variability="tunable", initial="exact")
        if added.value.unit:
            real.set("unit", added.value.unit)
        real.set("start", repr(float(added.value.value)))
    elif added.kind == "SIGNAL":
        scalar.attrib.update(causality="input", variability="continuous")
        real.set("start", "0.0")
    else:
        scalar.attrib.update(causality="local", variability="continuous", initial="calculated")


def _extend_structure(root: Element, layout: WrapperLayout, indices: dict[str, int]) -> None:
    """List the new derivatives; what effects touch may depend on anything from now on."""
    structure = root.find("ModelStructure")
    variables = root.find("ModelVariables")
    assert structure is not None
    assert variables is not None
    affected = {str(reference) for reference in layout.affected}
    ahead = any(e.site.kind in ("input", "parameter") for e in layout.repair.effects)
    for unknown in structure.iter("Unknown"):
        index = int(unknown.get("index", "0"))
        if ahead or variables[index - 1].get("valueReference") in affected:
            unknown.attrib.pop("dependencies", None)
            unknown.attrib.pop("dependenciesKind", None)
    rates = [indices[added.name] for added in layout.added if added.kind == "RATE"]
    states = [
        indices[added.name] for added in layout.added if added.kind == "STATE" and layout.exchange
    ]
    for tag, new, after in (
        ("Derivatives", rates, ("Outputs",)),
        ("InitialUnknowns", sorted(rates + states), ("Outputs", "Derivatives", "DiscreteStates")),
    ):
        section = _child(structure, tag, after) if new else None
        for index in new:
            assert section is not None
            SubElement(section, "Unknown", index=str(index))
