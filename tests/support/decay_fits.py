"""Fits of a decay by the command, in a folder of the test.

The truth is the solution of x' = -k x, x(0) = 1, by hand, times a gain: exp(-k t).
"""

import math
from pathlib import Path

import numpy as np
from support.run_folders import rows

from cluster_est.cli import main

RATE = 1.3
K = "parameters.k = { start = 0.7, bounds = [0.01, 10.0] }\n"


def decay_table(rate: float = RATE, gain: float = 1.0) -> str:
    times = np.linspace(0.0, 2.0, 21)
    lines = [f"{t!r},{gain * math.exp(-rate * t)!r}" for t in times.tolist()]
    return "time,y\n" + "\n".join(lines) + "\n"


def run_of(name: str) -> str:
    """An experiment of a config, whose data have its name."""
    return f'[[experiments]]\nid = "{name}"\ndata = "{name}.csv"\ntime = "time"\n' + (
        'outputs = { y = "y" }\n'
    )


def fit_decay(
    folder: Path,
    fmu: Path,
    *overrides: str,
    config: str = K,
    model: str = "",
    more: str = "",
    gain: float = 1.0,
) -> int:
    """Fit k, or what the config says, to the truth; the run is in `run`."""
    (folder / "a.csv").write_text(decay_table(gain=gain), encoding="utf-8")
    text = f'{config}\n[model]\nfmu = "{fmu}"\n{model}\n{run_of("a")}{more}'
    path = folder / "config.toml"
    path.write_text(text, encoding="utf-8")
    return main(["fit", str(path), "--out", str(folder / "run"), *overrides])


def estimate(folder: Path, name: str = "k") -> float:
    found = rows(folder / "run", "parameters")
    return next(float(row["value"]) for row in found if row["parameter"] == name)
