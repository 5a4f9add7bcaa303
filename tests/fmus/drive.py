"""One instance of a test model through fmpy, with the same names in both versions."""

from __future__ import annotations

from ctypes import c_double
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import extract, read_model_description
from fmpy.simulation import instantiate_fmu
from numpy.typing import NDArray


class Driven:
    """An instance that a test calls as it likes.

    Parameters
    ----------
    fmu : Path
        The archive.
    kind : {'ModelExchange', 'CoSimulation'}
        The interface.
    folder : Path
        Where to unpack it.
    """

    def __init__(self, fmu: Path, kind: str, folder: Path) -> None:
        self.description = read_model_description(fmu, validate=False)
        self.old = self.description.fmiVersion == "2.0"
        unpacked = folder / fmu.stem
        if not unpacked.exists():
            extract(fmu, unpacked)
        self.fmu: Any = instantiate_fmu(str(unpacked), self.description, kind)
        self.variables = {v.name: v for v in self.description.modelVariables}

    def reference(self, name: str) -> int:
        return int(self.variables[name].valueReference)

    def set(self, name: str, value: Any) -> None:
        values = value if isinstance(value, list) else [value]
        self._accessor("set", name)([self.reference(name)], values)

    def get(self, name: str, size: int | None = None) -> Any:
        get = self._accessor("get", name)
        if size is not None:
            return get([self.reference(name)], nValues=size)
        return get([self.reference(name)])[0]

    def _accessor(self, verb: str, name: str) -> Any:
        kind = self.variables[name].type
        if kind == "Enumeration":
            kind = "Integer" if self.old else "Int64"
        return getattr(self.fmu, verb + kind)

    def initialize(self, start: float = 0.0, stop: float | None = None) -> None:
        self.enter_initialization(start, stop)
        self.fmu.exitInitializationMode()

    def enter_initialization(self, start: float = 0.0, stop: float | None = None) -> None:
        if self.old:
            self.fmu.setupExperiment(startTime=start, stopTime=stop)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=start, stopTime=stop)

    def update(self) -> tuple[Any, ...]:
        """One round: again, terminate, nominals changed, values changed, next time known, it."""
        fmu = self.fmu
        return tuple(fmu.newDiscreteStates() if self.old else fmu.updateDiscreteStates())

    def settle(self) -> tuple[Any, ...]:
        """All rounds, then continuous time."""
        told = self.update()
        while told[0]:
            told = self.update()
        self.fmu.enterContinuousTimeMode()
        return told

    def vector(self, name: str, size: int) -> NDArray[np.float64]:
        """What the getter of that name says of all states or event indicators."""
        if name == "getDerivatives" and not self.old:
            name = "getContinuousStateDerivatives"
        values = (c_double * size)()
        getattr(self.fmu, name)(values, size)
        return np.array(values)

    def set_states(self, values: Any) -> None:
        self.fmu.setContinuousStates((c_double * len(values))(*values), len(values))

    def close(self) -> None:
        self.fmu.freeInstance()
