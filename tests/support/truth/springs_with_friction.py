"""A config whose spring has dry friction that its model lacks, solved by SciPy."""

import json
from pathlib import Path

import numpy as np
from support.problems.springs import FMU
from support.truth.springs_with_effects import START, pushed, solve

FRICTION, WIDTH = 0.6, 0.01
TIMES = np.arange(120) * 0.02
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


def write_config(
    folder: Path, friction: float = FRICTION, roles: tuple[str, ...] = ("train", "train", "test")
) -> Path:
    """Write the measurements and config.toml and give the config's path."""
    slope = pushed(lambda t, x, f: -friction * np.tanh(x[1] / WIDTH))
    text = HEAD.format(fmu=json.dumps(str(FMU)))
    for i, role in enumerate(roles):
        generator = np.random.default_rng([7, i])
        force = 3.0 * generator.normal(size=len(TIMES))
        truth = solve(slope, START, TIMES, force)[:, 0]
        measured = truth + NOISE * generator.normal(size=len(TIMES))
        rows = zip(TIMES, force, measured, strict=True)
        lines = ["t,force,position", *(",".join(repr(float(v)) for v in row) for row in rows)]
        (folder / f"run{i}.csv").write_text("\n".join(lines))
        text += EXPERIMENT.format(name=f"run{i}", role=role)
    path = folder / "config.toml"
    path.write_text(text)
    return path
