"""modelDescription.xml of the exported FMU: that of the original, with the added effects."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement

from cluster_est.model_export.wrapper_layout import AddedVariable, WrapperLayout, fits
from workers.fmu.archive import open_archive
from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable
from workers.fmu.xml import XML, ReadingNotes, flag, parse, whole
from workers.messages import Value

_ROOT = (
    "modelName", "description", "author", "version", "copyright", "license", "generationTool",
    "generationDateAndTime", "variableNamingConvention",
)  # fmt: skip
_RENAMED = {
    "canGetAndSetFMUState": "canGetAndSetFMUstate",
    "canSerializeFMUState": "canSerializeFMUstate",
    "providesDirectionalDerivatives": "providesDirectionalDerivative",
}
_KEPT = (
    "modelIdentifier", "needsExecutionTool", "canBeInstantiatedOnlyOncePerProcess",
    "canHandleVariableCommunicationStepSize",
)  # fmt: skip
_TAGS = {"real": "Real", "integer": "Integer", "boolean": "Boolean", "string": "String"}
_ATTRIBUTES = {
    "Real": (
        "quantity", "unit", "displayUnit", "relativeQuantity", "min", "max", "nominal", "unbounded",
    ),
    "Integer": ("quantity", "min", "max"),
    "Enumeration": ("quantity", "min", "max"),
    "Boolean": (),
    "String": (),
}  # fmt: skip
_NOTHING = {
    "Real": "0.0", "Integer": "0", "Enumeration": "1", "Boolean": "false", "String": "",
}  # fmt: skip
"""Start values for variables of the original without start values."""


def as_fmi_2(root: Element, description: ModelDescription) -> Element:
    """Convert the document of the original to FMI 2.0.

    Elements that FMI 2.0 lacks (clocks, terminals, annotations) are omitted.

    Parameters
    ----------
    root
        Document of FMI 3.0.
    description
        Description with the variables of FMI 2.0 (see `flatten` of `wrapper_layout.py`).
    """
    made = Element("fmiModelDescription", fmiVersion="2.0")
    made.attrib.update({key: root.get(key, "") for key in _ROOT if root.get(key) is not None})
    made.set("numberOfEventIndicators", str(description.event_indicators))
    if any(")[" in name for name in description.variables):
        made.set(
            "variableNamingConvention", "flat"
        )  # "der(x)[1]", a name of the run, is not structured
    for tag in ("ModelExchange", "CoSimulation"):
        if (section := root.find(tag)) is not None:
            made.append(_interface(tag, section, description))
    inverse = _add_fmi3_units(made, root)
    types = _add_types(made, root, inverse)
    if (categories := root.findall("LogCategories/Category")) != []:
        section = SubElement(made, "LogCategories")
        section.extend(Element("Category", each.attrib) for each in categories)
    if (usual := root.find("DefaultExperiment")) is not None:
        SubElement(made, "DefaultExperiment", usual.attrib)
    variables = _VariableWriter(description, types, inverse).section(root)
    made.append(variables)
    made.append(_structure(description, variables))
    return made


def _interface(tag: str, old: Element, description: ModelDescription) -> Element:
    made = Element(tag, {key: old.get(key, "") for key in _KEPT if old.get(key) is not None})
    made.attrib.update({new: old.get(key, "false") for key, new in _RENAMED.items()})
    if any(v.kind == "real" and v.size > 1 for v in description.variables.values()):
        made.attrib.pop("providesDirectionalDerivative")  # in FMI 3.0, they are for whole arrays
    if tag == "ModelExchange":
        needed = flag(old.get("needsCompletedIntegratorStep"))
        made.set("completedIntegratorStepNotNeeded", str(not needed).lower())
    return made


def _add_fmi3_units(made: Element, root: Element) -> set[str]:
    """Copy the units; return the display units that FMI 2.0 lacks."""
    inverse: set[str] = set()
    found = root.findall("UnitDefinitions/Unit")
    units = SubElement(made, "UnitDefinitions") if found else made
    for old in found:
        unit = SubElement(units, "Unit", name=old.get("name", ""))
        unit.extend(Element("BaseUnit", each.attrib) for each in old.findall("BaseUnit"))
        for display in old.findall("DisplayUnit"):
            given = dict(display.attrib)
            if flag(given.pop("inverse", None)):
                inverse.add(display.get("name", ""))
            else:
                SubElement(unit, "DisplayUnit", given)
    return inverse


def _add_types(made: Element, root: Element, inverse: set[str]) -> dict[str, Element]:
    """Declare the types; return, by name, the elements that describe their values."""
    types: dict[str, Element] = {}
    for old in root.iterfind("TypeDefinitions/*"):
        kind = old.tag.removesuffix("Type")
        tag = "Real" if kind.startswith("Float") else "Integer" if "Int" in kind else kind
        items = old.findall("Item")
        large = not all(fits(whole(item.get("value"))) for item in items)
        if tag not in _ATTRIBUTES or large:
            continue
        value = Element(tag, _limited(old, tag, inverse))
        for item in items:
            kept = {k: t for k in ("name", "value", "description") if (t := item.get(k))}
            SubElement(value, "Item", kept)
        types[old.get("name", "")] = value
    section = SubElement(made, "TypeDefinitions") if types else made
    for old in root.iterfind("TypeDefinitions/*"):
        if (name := old.get("name", "")) in types:
            simple = SubElement(section, "SimpleType", name=name)
            if about := old.get("description"):
                simple.set("description", about)
            simple.append(types[name])
    return types


def _limited(old: Element, tag: str, inverse: set[str]) -> dict[str, str]:
    """Return the attributes of a type that FMI 2.0 supports."""
    found = {key: text for key in _ATTRIBUTES[tag] if (text := old.get(key)) is not None}
    if found.get("displayUnit") in inverse:
        found.pop("displayUnit")
    for key in ("min", "max"):
        if tag != "Real" and key in found and not fits(whole(found[key])):
            found.pop(key)
    return found


@dataclass(frozen=True)
class _VariableWriter:
    """Writes the variables."""

    description: ModelDescription
    types: dict[str, Element]
    inverse: set[str]

    def section(self, root: Element) -> Element:
        made, places = Element("ModelVariables"), _places(self.description)
        raws: dict[str, Element] = {}
        for raw in root.iterfind("ModelVariables/*"):
            raws.setdefault(raw.get("name", ""), raw)
        for variable in self.description.variables.values():
            own = variable.alias_of or variable.name
            raw = raws[own.rpartition("[")[0] if variable.shape else own]
            scalar = SubElement(made, "ScalarVariable", name=variable.name)
            scalar.set("valueReference", str(variable.reference))
            if variable.description:
                scalar.set("description", variable.description)
            scalar.attrib.update(_role(variable, raw))
            value = self._value(variable, raw)
            scalar.append(value)
            if scalar.get("initial") in ("exact", "approx") or scalar.get("causality") == "input":
                value.set("start", _start(variable, raw, value.tag))
            if variable.derivative_of is not None and variable.alias_of is None:
                value.set("derivative", str(places[variable.derivative_of]))
        return made

    def _value(self, variable: ModelVariable, raw: Element) -> Element:
        tag, declared = _TAGS[variable.kind], raw.get("declaredType", "")
        if variable.type == "Enumeration" and declared in self.types:
            tag = "Enumeration"
        value = Element(tag, _limited(raw, tag, self.inverse))
        if declared in self.types and self.types[declared].tag == tag:
            value.set("declaredType", declared)
        if tag == "Real" and flag(raw.get("reinit")):
            value.set("reinit", "true")
        return value


def _places(description: ModelDescription) -> dict[str, int]:
    """Return the index of each variable in the document, from 1."""
    return {name: i for i, name in enumerate(description.variables, 1)}


def _role(variable: ModelVariable, raw: Element) -> dict[str, str]:
    """Return causality, variability and initial, including default values."""
    causality, variability = variable.causality, variable.variability
    alias = variable.alias_of is not None
    if causality == "independent" and not alias:
        return {"causality": causality, "variability": variability}
    if causality == "structuralParameter":  # fixed by the run, because array sizes depend on it
        causality, variability = "local", "constant"
    if alias:
        causality = "local"
    found = {"causality": causality, "variability": variability}
    if causality == "input":
        return found
    if variability == "constant" or causality == "parameter":
        return {**found, "initial": "exact"}
    # Of the aliases of a value, only the variable itself has a start value.
    return {**found, "initial": "calculated" if alias else raw.get("initial", "calculated")}


def _start(variable: ModelVariable, raw: Element, tag: str) -> str:
    """Return the start value of the original; for structural parameters, that of the run."""
    given = raw.get("start")
    if variable.kind == "string":
        return next((each.get("value", "") for each in raw.findall("Start")), given or "")
    if variable.causality == "structuralParameter" and variable.start is not None:
        return str(int(variable.start))
    texts = (given or "").split()
    if len(texts) not in (1, variable.size):
        return _NOTHING[tag]
    return texts[variable.element if len(texts) > 1 else 0]


def _structure(description: ModelDescription, section: Element) -> Element:
    made, places = Element("ModelStructure"), _places(description)
    rates = {
        v.derivative_of: name for name, v in description.variables.items() if v.alias_of is None
    }
    derivatives = [rates[state] for state in description.states]
    outputs = [name for name in description.outputs if name in places]
    initial = set()
    for scalar in section:
        name, causality = scalar.get("name", ""), scalar.get("causality")
        moves = name in outputs or name in derivatives or name in description.states
        if (moves and scalar.get("initial") != "exact") or causality == "calculatedParameter":
            initial.add(name)
    on = {(known.name, known.role): known.on for known in description.dependencies}
    _add_unknowns(made, "Outputs", outputs, [on.get((n, "output")) for n in outputs], places)
    dependencies = [on.get((n, "derivative")) for n in derivatives]
    _add_unknowns(made, "Derivatives", derivatives, dependencies, places)
    ordered = sorted(initial, key=lambda name: places[name])
    _add_unknowns(made, "InitialUnknowns", ordered, [None] * len(ordered), places)
    return made


def _add_unknowns(
    made: Element,
    tag: str,
    names: Sequence[str],
    dependencies: Sequence[tuple[str, ...] | None],
    places: dict[str, int],
) -> None:
    section = SubElement(made, tag) if names else made
    for name, on in zip(names, dependencies, strict=True):
        unknown = SubElement(section, "Unknown", index=str(places[name]))
        if on is not None:
            found = sorted(places[each] for each in on if each in places)
            unknown.set("dependencies", " ".join(map(str, found)))


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


def model_description(layout: WrapperLayout, guid: str, tool: str) -> bytes:
    """Return the document of the exported FMU.

    Parameters
    ----------
    layout
        Layout of the exported FMU.
    guid, tool
        Guid of the exported FMU, and the tool that made it.
    """
    model = layout.repair.problem.model
    with open_archive(model.name, model.archive) as opened:
        root = parse(model.name, opened.read(XML), ReadingNotes(model.name))
    if layout.repair.description.version == "3.0":
        root = as_fmi_2(root, layout.repair.description)
    old = {tag: root.find(tag) for tag in ("ModelExchange", "CoSimulation")}
    chosen = old["ModelExchange" if layout.exchange else "CoSimulation"]
    assert chosen is not None  # the run has used this interface
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
    for place, section in enumerate(_interfaces(layout, chosen)):
        root.insert(place, section)
    _add_units(root, layout)
    if layout.exchange:
        _default_experiment(root).set("tolerance", f"{layout.tolerance:g}")
    _set_starts(root, layout)
    indices = _add_variables(root, layout)
    _extend_structure(root, layout, indices)
    return as_document(root)


def with_step(document: bytes, step: float) -> bytes:
    """Return the document with a default step size, which many tools use unless told otherwise."""
    root = ET.fromstring(document)
    _default_experiment(root).set("stepSize", repr(step))
    return as_document(root)


def as_document(root: Element) -> bytes:
    """Return the text of an XML file."""
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def _default_experiment(root: Element) -> Element:
    definitions = ("UnitDefinitions", "TypeDefinitions", "LogCategories")
    return _child(root, "DefaultExperiment", ("ModelExchange", "CoSimulation", *definitions))


def _interfaces(layout: WrapperLayout, old: Element) -> list[Element]:
    kept = {"modelIdentifier": identifier(layout)}
    kept |= {name: text for name in _FLAGS if (text := old.get(name)) in ("true", "1")}
    if not layout.repair.effects and flag(old.get("providesDirectionalDerivative")):
        kept["providesDirectionalDerivative"] = "true"
    simulation = Element("CoSimulation", kept)
    simulation.set("canInterpolateInputs", "true")
    varies = layout.exchange or flag(old.get("canHandleVariableCommunicationStepSize"))
    simulation.set("canHandleVariableCommunicationStepSize", str(varies).lower())
    made = [simulation]
    if layout.exchange:
        exchange = Element("ModelExchange", kept)
        delays = any(e.form.memory for e in layout.repair.effects)
        unneeded = flag(old.get("completedIntegratorStepNotNeeded")) and not delays
        exchange.set("completedIntegratorStepNotNeeded", str(unneeded).lower())
        made.insert(0, exchange)
    return made


def _child(root: Element, tag: str, after: tuple[str, ...]) -> Element:
    """Return a section of the document, which is created in its place if missing."""
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
    """Set estimates as start values; of several names of a value, only where there is a start."""
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
    """Return a value in the format of an XML schema type."""
    if tag == "Boolean":
        return str(bool(given)).lower()
    return str(int(given)) if tag in ("Integer", "Enumeration") else str(given)


def _add_variables(root: Element, layout: WrapperLayout) -> dict[str, int]:
    """Append the added variables; return the index of each, which counts from 1."""
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
    """List the added derivatives; remove dependencies of variables that effects change."""
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
