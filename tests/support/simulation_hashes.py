"""Hashes of whole simulations by the core with its own elementary functions, a line each.

python tests/support/simulation_hashes.py
"""

import hashlib

import numpy as np
from support import core_batches, core_in_place
from support.problems.springs import FMU

from workers.core.library import core
from workers.fmu.description import describe
from workers.messages import Effect, Experiment, Input, Model, Output, Solver
from workers.messages.types import Interface, SolverName
from workers.simulation.simulator import Simulator

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


def hash_of(solver: SolverName, name: str) -> str:
    effects, coefficients = EFFECTS[name]
    interface: Interface = "co_simulation" if solver == "fmu" else "model_exchange"
    how = Solver(solver, rtol=1e-6)
    model = Model(FMU.name, FMU.read_bytes(), interface, how, ("m", "k", "c"))
    driven, recorded = Input("F", TIMES, FORCE), Output("y", TIMES, 0.0 * TIMES)
    experiment = Experiment("a", 0.0, float(TIMES[-1]), (driven,), (recorded,))
    simulator = Simulator(model, describe(FMU.name, model.archive), (experiment,))
    simulator.load()
    batch = simulator.run(0, np.array([[1.0, 25.0, 0.8, *coefficients]]), effects)
    assert batch.codes[0] == 0
    simulator.close()
    return hashlib.sha256(batch.outputs.tobytes()).hexdigest()[:16]


def main():
    for module in (core_batches, core_in_place):
        setattr(module, "with_c_library", core)  # noqa: B010
    core_in_place.install()
    solvers: tuple[SolverName, ...] = ("fmu", "rk4", "dormand_prince")
    for solver in solvers:
        for name, (effects, _) in EFFECTS.items():
            if solver != "fmu" or not any(e.site.startswith("der") for e in effects):
                print(solver, name, hash_of(solver, name))


if __name__ == "__main__":
    main()
