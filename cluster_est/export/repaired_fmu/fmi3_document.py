"""A modelDescription.xml of FMI 3.0 as one of FMI 2.0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement

from cluster_est.export.repaired_fmu.fmi3_variables import fits
from workers.fmu.description import ModelDescription
from workers.fmu.parsing.xml import flag, whole
from workers.fmu.variable import ModelVariable

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
"""Start values where the original names none."""


def as_fmi_2(root: Element, description: ModelDescription) -> Element:
    """The document of the original, in the words of FMI 2.0.

    What FMI 2.0 does not have (clocks, terminals, annotations) is left out.

    Parameters
    ----------
    root
        In FMI 3.0.
    description
        The same with the variables of FMI 2.0 (see `fmi3_variables.flatten`).
    """
    made = Element("fmiModelDescription", fmiVersion="2.0")
    made.attrib.update({key: root.get(key, "") for key in _ROOT if root.get(key) is not None})
    made.set("numberOfEventIndicators", str(description.event_indicators))
    if any(")[" in name for name in description.variables):
        made.set("variableNamingConvention", "flat")  # "der(x)[1]", which the run knows, is none
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
        made.attrib.pop("providesDirectionalDerivative")  # FMI 3.0 has them of whole arrays
    if tag == "ModelExchange":
        needed = flag(old.get("needsCompletedIntegratorStep"))
        made.set("completedIntegratorStepNotNeeded", str(not needed).lower())
    return made


def _add_fmi3_units(made: Element, root: Element) -> set[str]:
    """Copy the units. Returns the display units that FMI 2.0 does not have."""
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
    """Declare the types again. Returns, by name, what describes the values of each."""
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
    """The attributes of a type, without what FMI 2.0 cannot say."""
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
    """Causality, variability and initial; what they are by default is said too."""
    causality, variability = variable.causality, variable.variability
    alias = variable.alias_of is not None
    if causality == "independent" and not alias:
        return {"causality": causality, "variability": variability}
    if causality == "structuralParameter":  # the run has chosen it, and arrays have that size
        causality, variability = "local", "constant"
    if alias:
        causality = "local"
    found = {"causality": causality, "variability": variability}
    if causality == "input":
        return found
    if variability == "constant" or causality == "parameter":
        return {**found, "initial": "exact"}
    # Of several names of a value, its own has the start value.
    return {**found, "initial": "calculated" if alias else raw.get("initial", "calculated")}


def _start(variable: ModelVariable, raw: Element, tag: str) -> str:
    """As the original has it; structural parameters as the run has chosen them."""
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
