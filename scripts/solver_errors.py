"""How far the solvers are from closed forms, and from SciPy at a tolerance of 1e-12.

    python scripts/solver_errors.py [--fmi 2]

Test FMUs with state events, with time events, without events, and stiff ones, are simulated with
three tolerances (rk4: three steps). Printed is the largest error of the first output at all times,
those before and after each event among them, over the largest value.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from workers.fmu.description import describe
from workers.messages import Experiment, Model, Output, Solver
from workers.simulation.simulator import Simulator

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests"))

RTOLS, STEPS = (1e-4, 1e-6, 1e-8), (1e-1, 1e-2, 1e-3)
Course = Callable[[np.ndarray], np.ndarray]


def main() -> None:
    """Print the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fmi", type=int, choices=[2, 3], default=2)
    options = parser.parse_args()
    from fmus.build import build
    from support.truth import own_fmus as known

    cases: dict[str, tuple[str, str, dict[str, float], float, Course]] = {
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
    print("| | dormand_prince | | | cvode | | | rk4 | | |")
    print("|---" * 10 + "|")
    heads = [f"{x:g}" for x in (*RTOLS, *RTOLS)] + [f"{x:g} s" for x in STEPS]
    print("| | " + " | ".join(heads) + " |")
    with tempfile.TemporaryDirectory() as folder:
        for label, (name, output, values, stop, course) in cases.items():
            fmu = build(name, options.fmi, Path(folder))
            times = np.linspace(0.0, stop, 101)
            true = course(times)
            solvers = [Solver(s, rtol=r) for s in ("dormand_prince", "cvode") for r in RTOLS]
            solvers += [Solver("rk4", step) for step in STEPS if stop < 100.0]
            errors = [error(fmu, solver, output, values, times, true) for solver in solvers]
            print(f"| {label} | " + " | ".join(errors) + " |", flush=True)


def error(
    fmu: Path,
    solver: Solver,
    output: str,
    values: dict[str, float],
    times: np.ndarray,
    true: np.ndarray,
) -> str:
    """The largest error of one simulation, over the largest value."""
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", solver, tuple(values))
    run = Experiment("run", 0.0, float(times[-1]), (), (Output(output, times, 0.0 * times),))
    simulator = Simulator(model, describe(fmu.name, model.archive), (run,))
    simulator.load()
    record = simulator.run(0, np.array([list(values.values())]))
    simulator.close()
    if record.codes[0] != 0:
        return "fails"
    return f"{np.abs(record.outputs[0, :, 0] - true).max() / np.abs(true).max():.1e}"


if __name__ == "__main__":
    main()
