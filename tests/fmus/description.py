"""``modelDescription.xml`` of a test model, in both versions."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

from build_fmus import element
from fmus.variables import FLOATS, Model, Variable

FMI2_TYPES = {"Float64": "Real", "Int32": "Integer"}


def model_description(model: Model) -> bytes:
    """Return the document, the same for the same model."""
    root = ET.Element("fmiModelDescription", fmiVersion=f"{model.fmi}.0", modelName=model.name)
    root.set("guid" if model.fmi == 2 else "instantiationToken", model.token)
    root.set("description", model.spec["description"])
    root.set("variableNamingConvention", "structured")
    if model.fmi == 2:
        root.set("numberOfEventIndicators", str(len(model.indicators)))
    add_interfaces(root, model)
    add_definitions(root, model)
    categories = element(root, "LogCategories")
    element(categories, "Category", name="logStatusError", description="errors")
    stop, step = model.spec["stop"], model.spec["step"]
    element(root, "DefaultExperiment", startTime=0.0, stopTime=stop, stepSize=step)
    variables = element(root, "ModelVariables")
    for variable in model.variables:
        (add_scalar if model.fmi == 2 else add_variable)(variables, model, variable)
    (add_structure_2 if model.fmi == 2 else add_structure_3)(root, model)
    ET.indent(root)
    text = ET.tostring(root, encoding="UTF-8", xml_declaration=True).decode()
    for old, new in model.spec.get("replace", []):
        assert old in text, old
        text = text.replace(old, new, 1)
    return text.encode() + b"\n"


def add_interfaces(root: ET.Element, model: Model) -> None:
    """Describe what the FMU can do in model exchange and in co-simulation."""
    spec, old = model.spec, model.fmi == 2
    state = "FMUstate" if old else "FMUState"
    shared: dict[str, Any] = {
        "modelIdentifier": model.name,
        "needsExecutionTool": spec.get("needs_tool"),
        "canBeInstantiatedOnlyOncePerProcess": spec.get("only_once"),
        f"canGetAndSet{state}": True,
        f"canSerialize{state}": True,
        "providesDirectionalDerivative" + ("" if old else "s"): spec.get("directional"),
    }
    completed = spec.get("needs_completed_step", False)
    exchange: dict[str, Any] = {"needsCompletedIntegratorStep": completed}
    variable_steps = "fixed_step" not in spec
    stepping: dict[str, Any] = {"canHandleVariableCommunicationStepSize": variable_steps}
    if old:
        exchange = {"completedIntegratorStepNotNeeded": not completed}
        stepping["canInterpolateInputs"] = True
    kinds = {"ModelExchange": exchange, "CoSimulation": stepping}
    for kind in spec.get("interfaces", list(kinds)):
        element(root, kind, **shared, **kinds[kind])


def add_definitions(root: ET.Element, model: Model) -> None:
    """Define units, by name alone, and enumerations."""
    names = sorted({v.spec["unit"] for v in model.variables if "unit" in v.spec})
    if names:
        units = element(root, "UnitDefinitions")
        for name in names:
            element(units, "Unit", name=name)
    if enumerations := model.spec.get("enumerations"):
        types = element(root, "TypeDefinitions")
        for name, items in enumerations.items():
            if model.fmi == 2:
                parent = element(element(types, "SimpleType", name=name), "Enumeration")
            else:
                parent = element(types, "EnumerationType", name=name)
            for value, item in enumerate(items, 1):
                element(parent, "Item", name=item, value=value)


def common(variable: Variable) -> dict[str, Any]:
    """The attributes that both versions give to a variable itself."""
    return {
        "name": variable.name,
        "valueReference": variable.reference,
        "description": variable.spec.get("description"),
        "causality": variable.causality,
        "variability": variable.variability,
        "initial": variable.initial,
    }


def numbers(variable: Variable) -> dict[str, Any]:
    """The attributes of its type."""
    spec = variable.spec
    keys = ("unit", "min", "max", "nominal") if variable.type in FLOATS else ("min", "max")
    return {**{key: spec.get(key) for key in keys}, "declaredType": spec.get("declared")}


def add_scalar(parent: ET.Element, model: Model, variable: Variable) -> None:
    """Describe a variable, and its aliases, in FMI 2.0."""
    tag = FMI2_TYPES.get(variable.type, variable.type)
    derivative = index(model, model.by_name[variable.state]) if variable.state else None
    for name in (variable.name, *variable.spec.get("aliases", [])):
        scalar = element(parent, "ScalarVariable", **{**common(variable), "name": name})
        start = variable.spec.get("start")
        element(scalar, tag, **numbers(variable), start=start, derivative=derivative)


def add_variable(parent: ET.Element, model: Model, variable: Variable) -> None:
    """Describe a variable, and its aliases, in FMI 3.0."""
    spec = variable.spec
    derivative = model.by_name[variable.state].reference if variable.state else None
    start = spec.get("start")
    texts = variable.type in ("String", "Binary")
    if isinstance(start, list) and not texts:
        start = " ".join(str(s).lower() for s in start)
    described = element(
        parent,
        variable.type,
        **common(variable),
        **numbers(variable),
        derivative=derivative,
        start=None if texts else start,
    )
    for size in variable.dimensions:
        if isinstance(size, str):
            element(described, "Dimension", valueReference=model.by_name[size].reference)
        else:
            element(described, "Dimension", start=size)
    if texts and start is not None:
        for value in start if isinstance(start, list) else [start]:
            element(described, "Start", value=value)
    for name in spec.get("aliases", []):
        element(described, "Alias", name=name)


def index(model: Model, variable: Variable) -> int:
    """The place of a variable in an FMI 2.0 model description, which counts from 1."""
    before = model.variables[: variable.reference]
    return 1 + sum(1 + len(v.spec.get("aliases", [])) for v in before)


def add_structure_2(root: ET.Element, model: Model) -> None:
    """List outputs, derivatives and initial unknowns by their places."""
    structure = element(root, "ModelStructure")
    sections = {
        "Outputs": model.outputs,
        "Derivatives": model.derivatives,
        "InitialUnknowns": model.initial_unknowns,
    }
    for tag, variables in sections.items():
        if not variables:
            continue
        section = element(structure, tag)
        for variable in variables:
            names = variable.spec.get("depends") if tag != "InitialUnknowns" else None
            known = names and " ".join(str(index(model, model.by_name[n])) for n in names)
            element(section, "Unknown", index=index(model, variable), dependencies=known)
            for alias in range(len(variable.spec.get("aliases", [])) * (tag != "Derivatives")):
                element(section, "Unknown", index=index(model, variable) + alias + 1)


def add_structure_3(root: ET.Element, model: Model) -> None:
    """List outputs, derivatives, initial unknowns and event indicators by reference."""
    structure = element(root, "ModelStructure")
    sections = {
        "Output": model.outputs,
        "ContinuousStateDerivative": model.derivatives,
        "InitialUnknown": model.initial_unknowns,
        "EventIndicator": model.indicators,
    }
    for tag, variables in sections.items():
        for variable in variables:
            names = variable.spec.get("depends") if tag != "InitialUnknown" else None
            known = names and " ".join(str(model.by_name[n].reference) for n in names)
            element(structure, tag, valueReference=variable.reference, dependencies=known)
