"""Problems with known truth for the tests: mass-spring-dampers with exactly simulated data."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from support.truth.exact_linear import position

from cluster_est import Experiment, Input, Model, Output, Parameter, Problem, Solver

ROOT = Path(__file__).parents[3]
FMU = ROOT / "configs" / "models" / "mass_spring_damper.fmu"
TRUE = {"m": 1.2, "k": 30.0, "c": 0.6}


@dataclass(frozen=True)
class Truth:
    """A problem and what it was made with."""

    problem: Problem
    values: dict[str, float]


def spring_problem(
    experiments: int = 5,
    samples: int = 150,
    noise: float = 0.0,
    seed: int = 1,
    solver: Solver | None = None,
    local: tuple[str, ...] = ("x0",),
    interface: str = "model_exchange",
) -> Truth:
    """Shared m, k, c and, in each experiment, an initial position (and velocity) of its own."""
    generator = np.random.default_rng(seed)
    times = 0.02 * np.arange(samples, dtype=np.float64)
    values = dict(TRUE)
    runs = []
    for e in range(experiments):
        force = 3.0 * generator.normal(size=samples)
        x0 = float(generator.uniform(-0.2, 0.2))
        v0 = float(generator.uniform(-0.5, 0.5)) if "v0" in local else 0.0
        values |= {f"x0[e{e}]": x0} | ({f"v0[e{e}]": v0} if "v0" in local else {})
        measured = position(times, force, **TRUE, x0=x0, v0=v0)
        measured = measured + noise * generator.normal(size=samples)
        given, seen = Input("F", times, force), Output("y", times, measured)
        runs.append(Experiment(f"e{e}", 0.0, float(times[-1]), (given,), (seen,)))
    parameters = [
        Parameter("m", 1.0, (0.1, 10.0)),
        Parameter("k", 20.0, (1.0, 200.0), scale="log"),
        Parameter("c", 1.0, (0.0, 10.0)),
        Parameter("x0", 0.0, (-1.0, 1.0), variable="x", per="experiment"),
    ]
    if "v0" in local:
        parameters.append(Parameter("v0", 0.0, (-5.0, 5.0), variable="v", per="experiment"))
    chosen = solver or Solver("dormand_prince", rtol=1e-10)
    names = tuple(p.target for p in parameters)
    model = Model(FMU.name, FMU.read_bytes(), interface, chosen, names)  # type: ignore[arg-type]
    return Truth(Problem(model, tuple(parameters), tuple(runs)), values)
