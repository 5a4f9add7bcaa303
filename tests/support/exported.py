"""Exported FMUs as another tool sees them: through fmpy, call by call."""

import shutil
import zipfile
from collections.abc import Callable, Sequence
from ctypes import CFUNCTYPE, c_char_p, c_int, c_void_p, cast
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy import calloc, free, read_model_description
from fmpy.fmi2 import (
    FMU2Slave,
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)

from cluster_est import Parameter, Problem
from cluster_est.model_export.repaired_model import repaired
from cluster_est.model_export.write import ExportRequest, write_forms
from workers.effects.definition import define_all
from workers.fmu.description import describe_model
from workers.messages import Effect, Experiment, FloatArray, Model

NEEDS_CC = pytest.mark.skipif(
    shutil.which("cc") is None or fmpy.platform != "linux64",
    reason="building with the system's compiler needs cc on a 64-bit Linux",
)
"""For tests whose FMUs are built by the system's compiler."""


def repair_of(
    model: Model,
    experiment: Experiment,
    values: Sequence[float],
    effects: Sequence[Effect],
    coefficients: Sequence[float],
    errors: Sequence[dict[str, Any]] = (),
):
    """What a run with these values would give: they are declared to be known."""
    made = define_all(tuple(effects), describe_model(model), model.interface, (experiment,))
    names = [f"{each.effect.name}.{c.name}" for each in made for c in each.form.coefficients]
    known = zip((*model.parameters, *names), (*values, *coefficients), strict=True)
    parameters = tuple(Parameter(name, value, fixed=True) for name, value in known)
    problem = Problem(model, parameters, (experiment,), effects=tuple(effects))
    return repaired(problem, (), experiment.id, errors=errors)


def written(repair, path: Path) -> tuple[str, ...]:
    """Write an exported FMU and return the notes, but for that of other platforms."""
    notes = write_forms(repair, ExportRequest(fmu=path)).notes
    return tuple(note for note in notes if "does not run on" not in note)


def unpacked(repair, folder: Path) -> Path:
    """The exported FMU as a folder; beside it, in that folder, the archive."""
    written(repair, folder / "exported.fmu")
    with zipfile.ZipFile(folder / "exported.fmu") as archive:
        archive.extractall(folder)
    return folder


_LOGGER = CFUNCTYPE(None, c_void_p, c_char_p, c_int, c_char_p, c_char_p, c_char_p)
"""The wrapper's messages are one text behind "%s"."""


def _callbacks(said: list[str]) -> fmi2CallbackFunctions:
    """What an instance is told to call; its messages go into a list.

    Not through fmpy's proxy, of which there is one for all FMUs of a process.
    """
    callbacks = fmi2CallbackFunctions()
    logger = _LOGGER(lambda *arguments: said.append(arguments[-1].decode(errors="replace")))
    callbacks.logger = cast(logger, fmi2CallbackLoggerTYPE)
    callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
    callbacks.kept = logger
    return callbacks


class Exported:
    """An instance of an unpacked exported FMU."""

    def __init__(
        self, folder: Path, kind: type[Any] = FMU2Slave, said: list[str] | None = None
    ) -> None:
        described = read_model_description(str(folder))
        self.references = {v.name: v.valueReference for v in described.modelVariables}
        interface = described.coSimulation if kind is FMU2Slave else described.modelExchange
        self.fmu = kind(
            guid=described.guid,
            unzipDirectory=str(folder),
            modelIdentifier=interface.modelIdentifier,
            instanceName="one",
        )
        self.callbacks = _callbacks([] if said is None else said)
        self.fmu.instantiate(callbacks=self.callbacks)

    def set(self, name: str, value: float) -> None:
        self.fmu.setReal([self.references[name]], [value])

    def get(self, name: str) -> float:
        return float(self.fmu.getReal([self.references[name]])[0])

    def begin(self, given: dict[str, float], start: float = 0.0) -> None:
        """Initialise with start values or inputs."""
        self.fmu.setupExperiment(startTime=start)
        self.fmu.enterInitializationMode()
        for name, value in given.items():
            self.set(name, value)
        self.fmu.exitInitializationMode()

    def drive(self, name: str, value: float, slope: float) -> None:
        reference = self.references[name]
        self.fmu.setReal([reference], [value])
        self.fmu.setRealInputDerivatives([reference], [1], [slope])

    def close(self) -> None:
        self.fmu.terminate()
        self.fmu.freeInstance()


def co_simulated(
    exported: Exported,
    times: FloatArray,
    inputs: dict[str, FloatArray],
    output: str,
    *,
    hold: bool = False,
    first: int = 0,
) -> FloatArray:
    """The output at the times, the inputs linear between them, or held."""
    found = []
    for i in range(first, len(times)):
        last = i + 1 == len(times)
        for name, values in inputs.items():
            step = 1.0 if last else times[i + 1] - times[i]
            rise = 0.0 if last or hold else (values[i + 1] - values[i]) / step
            exported.drive(name, float(values[i]), float(rise))
        found.append(exported.get(output))
        if not last:
            exported.fmu.doStep(float(times[i]), float(times[i + 1] - times[i]))
    return np.array(found)


def finely_co_simulated(
    exported: Exported, times: FloatArray, inputs: dict[str, FloatArray], output: str
) -> FloatArray:
    """The same with ten communication steps from one time to the next.

    What lags behind an output sees a straight line over each step, as it cannot look ahead.
    """
    shares = np.arange(10 * (len(times) - 1) + 1) / 10.0
    fine = np.interp(shares, np.arange(len(times)), times)
    driven = {name: np.interp(fine, times, values) for name, values in inputs.items()}
    return co_simulated(exported, fine, driven, output)[::10]


def output_of(
    folder: Path,
    times: FloatArray,
    inputs: dict[str, FloatArray],
    output: str,
    given: dict[str, float] | None = None,
    follow: Callable[..., FloatArray] = co_simulated,
    **how: Any,
) -> FloatArray:
    """The output of an instance of its own, begun with these inputs and what else is given."""
    exported = Exported(folder)
    first = {name: float(values[0]) for name, values in inputs.items()}
    exported.begin((given or {}) | first, float(times[0]))
    found = follow(exported, times, inputs, output, **how)
    exported.close()
    return found
