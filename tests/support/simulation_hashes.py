"""Hashes of whole simulations, a line each: of every form of an effect, and of events.

PYTHONPATH=.:tests:scripts python tests/support/simulation_hashes.py [effects | --record]

prints them, with "effects" of those alone, which need no C compiler; or records them anew.

The FMUs add, multiply and divide, and call no function of the C library: all others are the core's.
"""

import hashlib
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from fmus.build import build
from support.problems.springs import FMU

from workers.effects.forms import FORMS
from workers.fmu.description import ModelDescription, describe
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
SPRING = (1.0, 25.0, 0.8)
"""Mass, stiffness and damping."""
EVENTFUL: dict[str, tuple[dict[str, float], tuple[str, ...], str]] = {
    "bouncing_ball": ({}, ("height", "bounces"), "der(v)"),
    "thermostat": ({"C": 10.0}, ("y", "on"), "der(T)"),
    "stair": ({}, ("y", "counter"), ""),
}
"""Values of parameters, outputs, and where a friction acts."""
Loaded = Callable[[Model, ModelDescription], None]
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
        if (kind, name) == ("input", "hysteresis"):
            values[:] = 0.01, 1.0, 0.5  # with shorter ones, the steps of rk4 are too long
        yield f"{kind}_{name}", Effect("e", SITES[kind], name, variables), values.tolist()


def simulated(
    model: Model, inputs: tuple[Input, ...], outputs: Sequence[str], loaded: Loaded
) -> Simulator:
    recorded = tuple(Output(name, TIMES, 0.0 * TIMES) for name in outputs)
    experiment = Experiment("a", 0.0, float(TIMES[-1]), inputs, recorded)
    description = describe(model.name, model.archive)
    simulator = Simulator(model, description, (experiment,))
    simulator.load()
    loaded(model, description)
    return simulator


def hash_of(simulator: Simulator, effects: tuple[Effect, ...], values: Sequence[float]) -> str:
    batch = simulator.run(0, np.array([values]), effects)
    assert batch.messages == [""]
    return hashlib.sha256(batch.outputs.tobytes()).hexdigest()[:16]


def of_effects(loaded: Loaded) -> Iterator[str]:
    for solver in SOLVERS:
        interface: Interface = "co_simulation" if solver == "fmu" else "model_exchange"
        how = Solver(solver, rtol=1e-6)
        model = Model(FMU.name, FMU.read_bytes(), interface, how, ("m", "k", "c"))
        simulator = simulated(model, (Input("F", TIMES, FORCE),), ("y",), loaded)
        for name, (effects, coefficients) in EFFECTS.items():
            if solver != "fmu" or not any(e.site.startswith("der") for e in effects):
                yield f"{solver} {name} {hash_of(simulator, effects, (*SPRING, *coefficients))}"
        for name, effect, values in of_every_form():
            if solver == "rk4" or (solver == "fmu" and effect.site.startswith("output")):
                yield f"{solver} {name} {hash_of(simulator, (effect,), (*SPRING, *values))}"
        simulator.close()


def of_events(loaded: Loaded) -> Iterator[str]:
    """Of models whose states, inputs or time bring events about, without and with an effect."""
    with tempfile.TemporaryDirectory() as folder:
        for name, (parameters, outputs, site) in EVENTFUL.items():
            archive = build(name, 2, Path(folder)).read_bytes()
            values = list(parameters.values())
            for solver in SOLVERS[1:]:
                how = Solver(solver, rtol=1e-6)
                model = Model(f"{name}.fmu", archive, "model_exchange", how, tuple(parameters))
                simulator = simulated(model, (), outputs, loaded)
                yield f"{solver} {name} {hash_of(simulator, (), values)}"
                if site:
                    effect = Effect("e", site, "stribeck", (site[4:-1],))
                    found = hash_of(simulator, (effect,), (*values, 0.5, 0.3, 0.1, 0.01))
                    yield f"{solver} {name}_stribeck {found}"
                simulator.close()


def nobody(_model: Model, _description: ModelDescription) -> None:
    """Who is told of an FMU where nothing is to be done with it."""


def lines(loaded: Loaded) -> Iterator[str]:
    """Simulate all; `loaded` is told of each FMU before the first simulation of it."""
    yield from of_effects(loaded)
    yield from of_events(loaded)


if __name__ == "__main__":
    found = of_effects(nobody) if sys.argv[1:] == ["effects"] else lines(nobody)
    text = "".join(f"{line}\n" for line in found)
    if sys.argv[1:] == ["--record"]:
        RECORDED.write_text(text, encoding="utf-8")
    else:
        print(text, end="")
