"""How far the solvers are from closed forms, and from SciPy at a tolerance of 1e-12.

Test FMUs (of version `fmi`) with state events, with time events, without events, and stiff ones,
are simulated with three tolerances (rk4: three steps). A row has the largest error of the first
output at all times, those before and after each event among them, over the largest value; NaN is a
simulation that fails.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from fmus.build import build
from support.truth import own_fmus as known

from benches import Row
from benches.common import Array
from workers.fmu.description import describe
from workers.messages import Experiment, Model, Output, Solver
from workers.simulation.simulator import Simulator

OPTIONS = {"fmi": 2}
RTOLS, STEPS = (1e-4, 1e-6, 1e-8), (1e-1, 1e-2, 1e-3)
SOLVERS = {
    **{f"{s} {r:g}": Solver(s, rtol=r) for s in ("dormand_prince", "cvode") for r in RTOLS},
    **{f"rk4 {step:g} s": Solver("rk4", step) for step in STEPS},
}
CASES: dict[str, tuple[str, str, dict[str, float], float, Callable[[Array], Array]]] = {
    "bouncing ball": ("bouncing_ball", "height", {}, 3.0, lambda t: known.bouncing_ball(t)[0]),
    "stair": ("stair", "y", {}, 4.5, known.stair),
    "dahlquist": ("dahlquist", "y", {}, 10.0, known.dahlquist),
    "van der Pol, mu = 1": (
        "van_der_pol", "y", {"mu": 1.0}, 20.0, lambda t: known.van_der_pol(t)[:, 0]
    ),
    "van der Pol, mu = 1000": (
        "van_der_pol", "y", {"mu": 1e3}, 2000.0, lambda t: known.van_der_pol(t, 1e3)[:, 0]
    ),
}  # fmt: skip


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each FMU."""
    with tempfile.TemporaryDirectory() as folder:
        for label, (name, output, values, stop, course) in CASES.items():
            fmu = build(name, options.fmi, Path(folder))
            times = np.linspace(0.0, stop, 101)
            row: Row = {"FMU": label}
            for head, solver in SOLVERS.items():
                if solver.name != "rk4" or stop < 100.0:
                    found = simulated(fmu, solver, output, values, times)
                    row[head] = largest(found, course(times))
            yield row


def simulated(
    fmu: Path, solver: Solver, output: str, values: dict[str, float], times: Array
) -> Array:
    """An output at all times; NaN if the simulation fails."""
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", solver, tuple(values))
    run = Experiment("run", 0.0, float(times[-1]), (), (Output(output, times, 0.0 * times),))
    simulator = Simulator(model, describe(fmu.name, model.archive), (run,))
    simulator.load()
    record = simulator.run(0, np.array([list(values.values())]))
    simulator.close()
    return np.asarray(record.outputs[0, :, 0] if record.codes[0] == 0 else np.full(101, np.nan))


def largest(found: Array, true: Array) -> float:
    """The largest error over the largest value."""
    return float(np.abs(found - true).max() / np.abs(true).max())
