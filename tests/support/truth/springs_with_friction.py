"""A config whose spring has dry friction that its model lacks: a Runge-Kutta of its own."""

import json
import math
from itertools import pairwise
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

    def slope(x: float, v: float, f: float) -> tuple[float, float]:
        return v, (f - k * x - c * v) / m - friction * math.tanh(v / WIDTH)

    x, v, found = START, 0.0, [START]
    step = (TIMES[1] - TIMES[0]) / SUBSTEPS
    for before, after in pairwise(force.tolist()):
        rise = (after - before) / SUBSTEPS
        for j in range(SUBSTEPS):
            f = before + j * rise
            xa, va = slope(x, v, f)
            xb, vb = slope(x + 0.5 * step * xa, v + 0.5 * step * va, f + 0.5 * rise)
            xc, vc = slope(x + 0.5 * step * xb, v + 0.5 * step * vb, f + 0.5 * rise)
            xd, vd = slope(x + step * xc, v + step * vc, f + rise)
            x += step / 6.0 * (xa + 2.0 * xb + 2.0 * xc + xd)
            v += step / 6.0 * (va + 2.0 * vb + 2.0 * vc + vd)
        found.append(x)
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
