"""The parameter set in the SSV format of the standard SSP 1.0 (Modelica Association, 2019)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from xml.etree.ElementTree import Element, SubElement

from cluster_est.export.repaired_model import RepairedModel
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
