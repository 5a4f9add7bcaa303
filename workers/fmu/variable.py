"""One variable of an FMU, whichever version of FMI describes it."""

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
        The value reference; that of the array, for an element of one.
    settable
        Whether its start value may be set before initialisation.
    tunable
        Whether it is a parameter that may change while the FMU runs.
    start, low, high
        None where the FMU names none. A Boolean starts at 0 or 1.
    type
        FMI 3's name of its type. FMI 2's Real is "Float64"; its Integer and Enumeration, which
        share their calls, are "Int32".
    derivative_of
        The variable whose derivative this is.
    aliases
        All names of the same value, this one among them; () if there is no other.
    alias_of
        For a further name that FMI 3 gives to a variable: the variable's own name.
    shape
        Of the array that this is an element of; () for a scalar.
    element
        Position in that array, in row-major order, from 0.
    size
        How many elements that array has.
    description
        What the FMU says that it is, on one line; "" if nothing.
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
        """True for a number that the FMU computes while it runs."""
        given = self.causality in ("parameter", "structuralParameter", "input", "independent")
        return self.kind in ("real", "integer", "boolean") and not given

    @property
    def is_read(self) -> bool:
        """True for a real number that the FMU computes."""
        return self.kind == "real" and self.is_computed

    @property
    def is_tool_setting(self) -> bool:
        """True for an option of the tool that exported the FMU: _nle_tolerance, $solver.step."""
        return any(part.startswith(("_", "$")) for part in self.name.split("."))

    @property
    def is_continuous(self) -> bool:
        """True if it may change between events."""
        return self.kind == "real" and self.variability == "continuous"
