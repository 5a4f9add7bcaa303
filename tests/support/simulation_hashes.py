"""Hashes of whole simulations, a line each: of every form of an effect, by several solvers.

PYTHONPATH=.:tests python tests/support/simulation_hashes.py [--record]

prints them, or records them anew.
"""

import hashlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from support.problems.springs import FMU

from workers.effects.forms import FORMS
from workers.fmu.description import describe
from workers.messages import Effect, Experiment, Input, Model, Output, Solver
from workers.messages.types import Interface, SolverName
from workers.simulation.simulator import Simulator

RECORDED = Path(__file__).parents[1] / "integration" / "core" / "simulation_hashes.txt"
TIMES = np.asarray(np.arange(501) * 0.01, np.float64)
FORCE = np.cumsum(np.arange(501) * 7919 % 104729 / 104729 - 0.5)
EFFECTS: dict[str, tuple[tuple[Effect, ...], tuple[float, ...]]] = {
    "none": ((), ()),
    "coulomb": ((Effect("e", "der(v)", "coulomb", ("v",)),), (0.5, 0.01)),
    "stribeck": ((Effect("e", "der(v)", "stribeck", ("v",)),), (0.5, 0.3, 0.1, 0.01)),
    "power": ((Effect("e", "der(v)", "power", ("v",)),), (0.2, 1.7, 2.0)),
    "lag": ((Effect("e", "input F", "lag", ()),), (0.05,)),
    "sine": ((Effect("e", "parameter k", "sine", ()),), (0.1, 0.2, 3.0)),
}
SOLVERS: tuple[SolverName, ...] = ("fmu", "rk4", "dormand_prince")
SITES = {
    "derivative": "der(v)", "input": "input F", "parameter": "parameter c", "pair": "pair x,v",
    "output": "output y",
}  # fmt: skip


def of_every_form() -> Iterator[tuple[str, Effect, Sequence[float]]]:
    """An effect of each form, with a name and coefficients that let it act."""
    for (kind, name), form in FORMS.items():
        known = {"output": ("F", "x"), "pair": ("x", "v")}.get(kind, ("x", "F"))
        variables: tuple[str, ...] = known[: form.variables]
        if kind == "pair" and form.variables == 1:
            variables = ("x - v",)
        values = 0.005 + np.arange(1, 1 + len(form.coefficients)) * 0.037 % 0.03
        for i, coefficient in enumerate(form.coefficients):
            values[i] = {"low": -0.01, "high": 0.01}.get(coefficient.name, values[i])
        yield f"{kind}_{name}", Effect("e", SITES[kind], name, variables), values.tolist()


def simulated(solver: SolverName) -> Simulator:
    interface: Interface = "co_simulation" if solver == "fmu" else "model_exchange"
    how = Solver(solver, rtol=1e-6)
    model = Model(FMU.name, FMU.read_bytes(), interface, how, ("m", "k", "c"))
    driven, recorded = Input("F", TIMES, FORCE), Output("y", TIMES, 0.0 * TIMES)
    experiment = Experiment("a", 0.0, float(TIMES[-1]), (driven,), (recorded,))
    simulator = Simulator(model, describe(FMU.name, model.archive), (experiment,))
    simulator.load()
    return simulator


def hash_of(simulator: Simulator, effects: tuple[Effect, ...], values: Sequence[float]) -> str:
    batch = simulator.run(0, np.array([[1.0, 25.0, 0.8, *values]]), effects)
    return hashlib.sha256(batch.outputs.tobytes()).hexdigest()[:16]


def lines() -> Iterator[str]:
    for solver in SOLVERS:
        simulator = simulated(solver)
        for name, (effects, coefficients) in EFFECTS.items():
            if solver != "fmu" or not any(e.site.startswith("der") for e in effects):
                yield f"{solver} {name} {hash_of(simulator, effects, coefficients)}\n"
        for name, effect, values in of_every_form():
            if solver == "rk4" or (solver == "fmu" and effect.site.startswith("output")):
                yield f"{solver} {name} {hash_of(simulator, (effect,), values)}\n"
        simulator.close()


if __name__ == "__main__":
    found = "".join(lines())
    if "--record" in sys.argv:
        RECORDED.write_text(found, encoding="utf-8")
    else:
        print(found, end="")
