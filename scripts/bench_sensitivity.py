"""Sensitivity indices of FMUs whose indices are known, and of one with 200 parameters.

    python scripts/bench_sensitivity.py

The Ishigami function and the g-function of Sobol as FMUs: printed is the largest difference of the
Sobol indices to the analytic ones. Then an FMU with 200 parameters, 12 of which matter: printed is
how many of these are among the first 15 of the ranking by elementary effects.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from build_fmus import build

import cluster_est as ce
from cluster_est.sensitivity.analysis import sensitivity
from cluster_est.sensitivity.result import SensitivityResult
from cluster_est.sensitivity.settings import SensitivitySettings
from workers.messages import FloatArray

A, B = 7.0, 0.1
COEFFICIENTS = (0.0, 1.0, 4.5, 9.0, 99.0, 99.0, 99.0, 99.0)
PARAMETERS, PLANTED = 200, 12
SAMPLES = 11


@dataclass(frozen=True)
class StaticModel:
    """An FMU whose only output is a function of its parameters.

    Attributes
    ----------
    name
        Of the FMU.
    size, low, high
        Number of parameters "x0", "x1" ..., and their bounds.
    equation
        Of the output y, in C.
    """

    name: str
    size: int
    low: float
    high: float
    equation: str

    def problem(self, folder: Path) -> ce.Problem:
        """Build the FMU; its data are zeros."""
        names = [f"x{i}" for i in range(self.size)]
        start = 0.3 * self.low + 0.7 * self.high
        own = folder / self.name
        own.mkdir()
        entries = [f'description = "{self.name}"', "max_step = 0.1", "[experiment]"]
        entries += ["stop = 1.0", "step = 0.1", "[units]", '"1" = {}']
        for name in names:
            entries += ["[[variable]]", f'name = "{name}"', 'causality = "parameter"']
            entries += ['unit = "1"', 'variability = "tunable"', f"start = {start}"]
        entries += ["[[variable]]", 'name = "y"', 'causality = "output"', 'unit = "1"']
        entries += [
            "[[variable]]",
            'name = "z"',
            'causality = "local"',
            'unit = "1"',
            "start = 0.0",
        ]
        entries += ['derivative = { name = "der(z)", unit = "1" }']
        body = f"    M(y) = {self.equation};\n    M(der_z) = 0.0;\n"
        text = '#include <math.h>\n#include "fmi2_model.h"\n\n'
        text += "fmi2Status model_equations(Model *m)\n{\n"
        (own / "model.c").write_text(f"{text}{body}    return fmi2OK;\n}}\n", "utf-8")
        (own / "model.toml").write_text("\n".join(entries) + "\n", "utf-8")
        archive = build(own, folder).read_bytes()
        times = np.linspace(0.0, 1.0, SAMPLES)
        run = ce.Experiment("e", 0.0, 1.0, (), (ce.Output("y", times, np.zeros(SAMPLES)),))
        model = ce.Model(self.name, archive, "model_exchange", ce.Solver("rk4"), tuple(names))
        parameters = tuple(ce.Parameter(name, start, self.low, self.high) for name in names)
        return ce.Problem(model, parameters, (run,))


def ishigami() -> tuple[StaticModel, FloatArray, FloatArray]:
    """The function with its indices of first order and total ones."""
    equation = f"sin(M(x0)) + {A} * pow(sin(M(x1)), 2) + {B} * pow(M(x2), 4) * sin(M(x0))"
    v1, v2 = 0.5 * (1.0 + B * np.pi**4 / 5.0) ** 2, A**2 / 8.0
    v13 = 8.0 * B**2 * np.pi**8 / 225.0
    whole = v1 + v2 + v13
    model = StaticModel("ishigami", 3, -np.pi, np.pi, equation)
    return model, np.array([v1, v2, 0.0]) / whole, np.array([v1 + v13, v2, v13]) / whole


def g_function() -> tuple[StaticModel, FloatArray, FloatArray]:
    """The function with its indices of first order and total ones."""
    factors = [f"(fabs(4.0 * M(x{i}) - 2.0) + {a}) / {1.0 + a}" for i, a in enumerate(COEFFICIENTS)]
    parts = 1.0 / (3.0 * (1.0 + np.array(COEFFICIENTS)) ** 2)
    whole = float(np.prod(1.0 + parts))
    model = StaticModel("g_function", len(COEFFICIENTS), 0.0, 1.0, " * ".join(factors))
    return model, parts / (whole - 1.0), parts * whole / (1.0 + parts) / (whole - 1.0)


def planted() -> tuple[StaticModel, list[str]]:
    """A function of 200 parameters, and the names of those that matter."""
    random = np.random.default_rng(5)
    strong = sorted(random.choice(PARAMETERS, PLANTED, replace=False).tolist())
    weights = 0.02 * random.uniform(0.2, 1.0, PARAMETERS)
    weights[strong] = random.uniform(0.5, 2.0, PLANTED)
    terms = [f"{w:.6f} * M(x{i})" for i, w in enumerate(weights)]
    pairs = [f"0.3 * M(x{i}) * M(x{j})" for i, j in zip(strong[::2], strong[1::2], strict=True)]
    model = StaticModel("planted", PARAMETERS, 0.0, 1.0, " + ".join([*terms, *pairs]))
    return model, [f"x{i}" for i in strong]


def indices(found: SensitivityResult, name: str) -> FloatArray:
    """An index of the output at the last time, for each parameter."""
    rows = [r for r in found.indices if r.index == name and r.output == "y" and r.time == 1.0]
    return np.array([row.value for row in rows])


def main() -> int:
    """Print the figures; 1 if one falls short."""
    short = False
    with tempfile.TemporaryDirectory() as folder:
        for model, first, total in (ishigami(), g_function()):
            begin = time.perf_counter()
            settings = SensitivitySettings(method="sobol", groups=4096, times=2)
            found = sensitivity(model.problem(Path(folder)), settings=settings)
            off = max(
                float(np.abs(indices(found, "first order") - first).max()),
                float(np.abs(indices(found, "total") - total).max()),
            )
            short |= off > 0.02
            print(
                f"{model.name}: Sobol indices off by {off:.4f} at most, {found.simulated} "
                f"simulations, {time.perf_counter() - begin:.1f} s",
                flush=True,
            )
        model, strong = planted()
        begin = time.perf_counter()
        found = sensitivity(model.problem(Path(folder)))
        leading = [unknown.label for unknown in found.ranking[:15]]
        hits = len(set(strong) & set(leading))
        short |= hits < PLANTED
        print(
            f"{PARAMETERS} parameters: {hits} of {PLANTED} that matter among the first 15, "
            f"{found.simulated} simulations, {time.perf_counter() - begin:.1f} s"
        )
    return int(short)


if __name__ == "__main__":
    sys.exit(main())
