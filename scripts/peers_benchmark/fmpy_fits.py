"""SciPy's least squares around FMPy, as one would write it by hand, in one process or a pool.

The FMU is unpacked once. A process keeps what it needs in a global, because SciPy pickles the
residual function for each call.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.pool import Pool
from typing import Any

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Model, FMU2Slave
from scipy.optimize import least_squares

from peers_benchmark.case import FMPY_NAMES, FMU, RTOL, Case, Record


@dataclass(frozen=True)
class Fit:
    """What a tool found, and how long it took once its workers stood.

    Attributes
    ----------
    values
        Of the unknowns.
    seconds
        From the call to the result.
    simulations
        None where the tool does not tell.
    """

    values: tuple[float, ...]
    seconds: float
    simulations: int | None


class Loop:
    """Simulates the records of a case with FMPy in one of three ways."""

    def __init__(self, case: Case, folder: str, way: str) -> None:
        self.case, self._folder = case, folder
        self._description = fmpy.read_model_description(folder)
        variables = self._description.modelVariables
        self._references = {v.name: v.valueReference for v in variables}
        self._simulate: Callable[[Record, dict[str, float]], np.ndarray] = getattr(self, way)
        exchange = case.interface == "model_exchange"
        part = self._description.modelExchange if exchange else self._description.coSimulation
        self._instance = (FMU2Model if exchange else FMU2Slave)(
            guid=self._description.guid,
            modelIdentifier=part.modelIdentifier,
            unzipDirectory=folder,
        )
        self._instance.instantiate()

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Simulated - measured, of all records."""
        parts = []
        for record in self.case.records:
            own = {self.case.unknowns[i]: float(x[i]) for i in record.own}
            parts.append(self._simulate(record, record.values | own) - record.measured)
        return np.concatenate(parts)

    def cold(self, record: Record, values: dict[str, float]) -> np.ndarray:
        """`simulate_fmu` on the unpacked folder: a new instance for each simulation."""
        return self._simulate_fmu(record, values)

    def reused(self, record: Record, values: dict[str, float]) -> np.ndarray:
        """`simulate_fmu` on an instance that is reset."""
        self._instance.reset()
        return self._simulate_fmu(record, values, fmu_instance=self._instance)

    def by_hand(self, record: Record, values: dict[str, float]) -> np.ndarray:
        """A loop over FMPy's `FMU2Slave`, without the bookkeeping of `simulate_fmu`."""
        fmu, times, force = self._instance, record.times.tolist(), record.force.tolist()
        u, y = [self._references["F"]], [self._references["y"]]
        fmu.reset()
        fmu.setupExperiment(startTime=times[0])
        fmu.setReal([self._references[name] for name in values], list(values.values()))
        fmu.setReal(u, force[:1])
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        outputs = fmu.getReal(y)
        for i in range(len(times) - 1):
            fmu.setReal(u, force[i : i + 1])
            fmu.doStep(times[i], times[i + 1] - times[i])
            outputs += fmu.getReal(y)
        return np.array(outputs)

    def _simulate_fmu(self, record: Record, values: dict[str, float], **options: Any) -> np.ndarray:
        if np.ptp(record.force) == 0.0:
            values = values | {"F": float(record.force[0])}  # faster than a table of it
        else:
            table = np.zeros(len(record.times), dtype=[("time", float), ("F", float)])
            table["time"], table["F"] = record.times, record.force
            options["input"] = table
        found = fmpy.simulate_fmu(
            self._folder,
            model_description=self._description,
            fmi_type=FMPY_NAMES[self.case.interface],
            relative_tolerance=RTOL if self.case.interface == "model_exchange" else None,
            start_values=values,
            output=["y"],
            start_time=record.times[0],
            stop_time=record.times[-1],
            output_interval=record.times[1] - record.times[0],
            **options,
        )
        return np.asarray(found["y"])


_loop: Loop | None = None


def prepare(case: Case, folder: str, way: str) -> None:
    """Make this process ready for `residuals`."""
    global _loop
    _loop = Loop(case, folder, way)


def residuals(x: np.ndarray) -> np.ndarray:
    """What SciPy calls, here or in a process of the pool."""
    if _loop is None:
        raise RuntimeError("prepare() must be called in each process first")
    return _loop.residuals(x)


def cost(case: Case, folder: str, values: tuple[float, ...]) -> float:
    """Sum of squared residuals, computed the same way for all."""
    way = "by_hand" if case.interface == "co_simulation" else "reused"
    found = Loop(case, folder, way).residuals(np.array(values))
    return float(np.add.reduce(found**2))


def fit(case: Case, folder: str, way: str, pool: Pool | None) -> Fit:
    """Run SciPy's least squares with its own settings."""
    prepare(case, folder, way)
    begin = time.perf_counter()
    found = least_squares(
        residuals,
        case.start,
        bounds=(case.lower, case.upper),
        x_scale="jac",
        workers=None if pool is None else pool.map,
    )
    seconds = time.perf_counter() - begin
    # nfev leaves out the points of the differences: one for each unknown and Jacobian
    points = found.nfev + found.njev * len(case.start)
    return Fit(tuple(found.x.tolist()), seconds, points * len(case.records))


def unpack(folder: str) -> str:
    """Unpack the FMU once."""
    return str(fmpy.extract(str(FMU), unzipdir=folder))
