"""A config whose spring has dry friction that its model lacks: NumPy's own Runge-Kutta."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from support.problems.springs import FMU, TRUE

FRICTION, WIDTH = 0.6, 0.01
TIMES = np.arange(120) * 0.02
SUBSTEPS = 20
START = 0.1
NOISE = 1e-3

HEAD = """
[model]
fmu = {fmu}

[parameters]
m = {{ start = 1.0, bounds = [0.1, 10.0] }}
k = {{ start = 25.0, bounds = [1.0, 100.0] }}
c = {{ start = 0.8, bounds = [0.0, 10.0] }}

[closed_loop]
effects = ["coulomb", "cubic", "constant"]
sites = ["der(v)"]
max_effects = 1
draws = 400
pairs = false
"""
EXPERIMENT = """
[[experiments]]
id = "{name}"
data = "{name}.csv"
time = "t"
inputs = {{ F = "force" }}
outputs = {{ y = "position" }}
values = {{ x = 0.1 }}
role = "{role}"
"""


def position(force: np.ndarray, friction: float) -> np.ndarray:
    """x(t) of m v' = F - k x - c v - m friction tanh(v / width), by classic Runge-Kutta."""
    m, k, c = TRUE["m"], TRUE["k"], TRUE["c"]

    def slope(x: np.ndarray, f: float) -> np.ndarray:
        dry = friction * np.tanh(x[1] / WIDTH)
        return np.array([x[1], (f - k * x[0] - c * x[1]) / m - dry])

    x, found = np.array([START, 0.0]), [START]
    step = (TIMES[1] - TIMES[0]) / SUBSTEPS
    for i in range(len(TIMES) - 1):
        rise = (force[i + 1] - force[i]) / SUBSTEPS
        for j in range(SUBSTEPS):
            f = force[i] + j * rise
            a = slope(x, f)
            b = slope(x + 0.5 * step * a, f + 0.5 * rise)
            d = slope(x + 0.5 * step * b, f + 0.5 * rise)
            e = slope(x + step * d, f + rise)
            x = x + step / 6.0 * (a + 2.0 * b + 2.0 * d + e)
        found.append(float(x[0]))
    return np.array(found)


def write_config(
    folder: Path, friction: float = FRICTION, roles: tuple[str, ...] = ("train", "train", "test")
) -> Path:
    """Write the measurements and config.toml and give the config's path."""
    text = HEAD.format(fmu=json.dumps(str(FMU)))
    for i, role in enumerate(roles):
        generator = np.random.default_rng([7, i])
        force = 3.0 * generator.normal(size=len(TIMES))
        measured = position(force, friction) + NOISE * generator.normal(size=len(TIMES))
        rows = zip(TIMES, force, measured, strict=True)
        lines = ["t,force,position", *(",".join(repr(float(v)) for v in row) for row in rows)]
        (folder / f"run{i}.csv").write_text("\n".join(lines))
        text += EXPERIMENT.format(name=f"run{i}", role=role)
    path = folder / "config.toml"
    path.write_text(text)
    return path
