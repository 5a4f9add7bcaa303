"""A variable of an FMU, independent of the version of FMI."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["real", "integer", "boolean", "string", "binary", "clock"]
Type = Literal[
    "Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64",
    "UInt64", "Boolean", "Enumeration", "String", "Binary", "Clock",
]  # fmt: skip

KINDS: dict[Type, Kind] = {
    "Float64": "real",
    "Float32": "real",
    "Int8": "integer",
    "UInt8": "integer",
    "Int16": "integer",
    "UInt16": "integer",
    "Int32": "integer",
    "UInt32": "integer",
    "Int64": "integer",
    "UInt64": "integer",
    "Enumeration": "integer",
    "Boolean": "boolean",
    "String": "string",
    "Binary": "binary",
    "Clock": "clock",
}


@dataclass(frozen=True)
class ModelVariable:
    """One number (or text) of an FMU: a scalar variable, or one element of an array variable.

    Attributes
    ----------
    reference
        The value reference; for an element of an array, that of the array.
    settable
        Whether its start value may be set before initialisation.
    tunable
        Whether it is a parameter that may change while the FMU runs.
    start, low, high
        None if not declared. A Boolean starts at 0 or 1.
    type
        Name of its type in FMI 3. In FMI 2, Real is "Float64"; Integer and Enumeration, which use
        the same functions, are "Int32".
    derivative_of
        The variable whose derivative this is.
    aliases
        All names of the same value, including this one; () if there is no other.
    alias_of
        For an additional name that FMI 3 gives to a variable: the variable's own name.
    shape
        Shape of the array that contains this element; () for a scalar.
    element
        Position in that array, in row-major order, from 0.
    size
        Number of elements of that array.
    description
        The FMU's description, on one line; "" if there is none.
    """

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
    type: Type = "Float64"
    variability: str = "continuous"
    derivative_of: str | None = None
    aliases: tuple[str, ...] = ()
    alias_of: str | None = None
    shape: tuple[int, ...] = ()
    element: int = 0
    size: int = 1
    description: str = ""

    @property
    def is_computed(self) -> bool:
        """Whether it is a number that the FMU computes during the simulation."""
        given = self.causality in ("parameter", "structuralParameter", "input", "independent")
        return self.kind in ("real", "integer", "boolean") and not given

    @property
    def is_read(self) -> bool:
        """Whether it is a real number that the FMU computes."""
        return self.kind == "real" and self.is_computed

    @property
    def is_tool_setting(self) -> bool:
        """Whether it is an option of the export tool, such as _nle_tolerance or $solver.step."""
        return any(part.startswith(("_", "$")) for part in self.name.split("."))

    @property
    def is_continuous(self) -> bool:
        """Whether it may change between events."""
        return self.kind == "real" and self.variability == "continuous"
