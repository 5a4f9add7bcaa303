"""The variables of a test model, as `model.toml` names them, and what follows for both versions."""

from __future__ import annotations

import hashlib
import re
import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
MODELS = FOLDER / "models"
COMMON = FOLDER / "common"

CALCULATED = {"output", "local"}
FLOATS = {"Float64", "Float32"}
BEFORE_START = "INSTANTIATED | INITIALIZATION"
WHILE_RUNNING = f"{BEFORE_START} | EVENT_MODE | STEPPING"


@dataclass(frozen=True)
class Variable:
    """One variable; `spec` holds the keys of `model.toml`.

    Those are name, type (Float64 by default), causality (local by default), variability, start,
    unit, min, max, nominal, dimensions, declared (an enumeration), aliases, depends, derivative
    (the name of the variable that a state's derivative is), indicator, description.
    """

    reference: int
    spec: dict[str, Any]
    state: str | None = None

    @property
    def name(self) -> str:
        return str(self.spec["name"])

    @property
    def identifier(self) -> str:
        """The name in C: ``der(x)`` becomes ``der_x``."""
        return re.sub(r"\W+", "_", self.name).strip("_")

    @property
    def type(self) -> str:
        return str(self.spec.get("type", "Float64"))

    @property
    def causality(self) -> str:
        return str(self.spec.get("causality", "local"))

    @property
    def variability(self) -> str:
        default = "continuous" if self.type in FLOATS else "discrete"
        default = "fixed" if "arameter" in self.causality else default
        return str(self.spec.get("variability", default))

    @property
    def initial(self) -> str | None:
        """Exact with a start value, calculated without one, None where the standard says so."""
        if self.causality not in CALCULATED:
            return None
        return "exact" if "start" in self.spec else "calculated"

    @property
    def settable(self) -> str:
        """The phases, as named in C, in which a value may be set."""
        if self.initial == "calculated" or self.causality == "independent":
            return "0"
        if self.causality == "structuralParameter":
            return "CONFIGURATION"
        if self.causality == "input":
            continuous = self.variability == "continuous"
            return WHILE_RUNNING + (" | CONTINUOUS_TIME" if continuous else "")
        return WHILE_RUNNING if self.variability == "tunable" else BEFORE_START

    @property
    def dimensions(self) -> list[Any]:
        """Numbers, or names of structural parameters."""
        return list(self.spec.get("dimensions", []))


@dataclass(frozen=True)
class Model:
    """A test model for one version of the standard."""

    name: str
    fmi: int
    spec: dict[str, Any]
    variables: list[Variable]
    sources: dict[str, bytes]

    @cached_property
    def token(self) -> str:
        """A hash of everything that makes the model."""
        digest = hashlib.sha256(repr((self.fmi, self.spec)).encode())
        for name, text in sorted(self.sources.items()):
            digest.update(name.encode() + text)
        return "{" + digest.hexdigest()[:32] + "}"

    @cached_property
    def by_name(self) -> dict[str, Variable]:
        return {v.name: v for v in self.variables}

    @property
    def states(self) -> list[Variable]:
        return [v for v in self.variables if "derivative" in v.spec]

    @property
    def derivatives(self) -> list[Variable]:
        return [self.by_name[v.spec["derivative"]] for v in self.states]

    @property
    def outputs(self) -> list[Variable]:
        return [v for v in self.variables if v.causality == "output"]

    @property
    def indicators(self) -> list[Variable]:
        return [v for v in self.variables if v.spec.get("indicator")]

    @property
    def initial_unknowns(self) -> list[Variable]:
        unknown = {v.reference for v in self.derivatives}
        unknown |= {v.reference for v in self.outputs if v.initial == "calculated"}
        return [v for v in self.variables if v.reference in unknown]


def read_model(name: str, fmi: int) -> Model:
    """Read a model; its variables with another ``fmi`` than this version are left out."""
    folder = MODELS / name
    spec = tomllib.loads((folder / "model.toml").read_text(encoding="utf-8"))
    variables = [Variable(0, {"name": "time", "causality": "independent"})]
    for entry in spec.pop("variables"):
        if entry.get("fmi", fmi) != fmi:
            continue
        variables.append(Variable(len(variables), entry))
        if rate := entry.get("derivative"):
            sizes = {"dimensions": entry["dimensions"]} if "dimensions" in entry else {}
            depends = {"depends": entry["depends"]} if "depends" in entry else {}
            rate_spec = {"name": rate, **sizes, **depends}
            variables.append(Variable(len(variables), rate_spec, entry["name"]))
    other = f"fmi{5 - fmi}.c"
    files = [folder / "model.c", *(f for f in sorted(COMMON.iterdir()) if f.name != other)]
    return Model(name, fmi, spec, variables, {f.name: f.read_bytes() for f in files})
