"""FMUs as models, and the mass-spring-damper driven by the force of `springs_with_effects`."""

from __future__ import annotations

from pathlib import Path

from support.problems.springs import FMU
from support.truth.springs_with_effects import FORCE, START, TIMES

from cluster_est import Experiment, Input, Model, Output, Solver

SPRING = ("m", "k", "c")


def model_of(solver: Solver, parameters: tuple[str, ...] = SPRING, path: Path = FMU) -> Model:
    """The spring, or another FMU; with its own solver in co-simulation."""
    interface = "co_simulation" if solver.name == "fmu" else "model_exchange"
    return Model(path.name, path.read_bytes(), interface, solver, parameters)  # type: ignore[arg-type]


def driven(measured=None, shown="y", force=FORCE, how="linear") -> Experiment:
    """The spring let go at its start and pushed; without a measurement it is compared with 0."""
    values = 0.0 * TIMES if measured is None else measured
    output = Output(shown, TIMES, values)  # type: ignore[arg-type]
    pushed = Input("F", TIMES, force, how)  # type: ignore[arg-type]
    start = (("x", START[0]),)
    return Experiment("e", 0.0, float(TIMES[-1]), (pushed,), (output,), start)
