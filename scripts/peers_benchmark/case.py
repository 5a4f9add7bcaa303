"""The embedded example as every tool can be given it: inputs are held from sample to sample.

FMPy holds them in co-simulation, and so co-simulation with held inputs is the one setting in which
all tools simulate the same thing, to the last digits. In model exchange FMPy applies no sampled
inputs, so only the experiment without a force can be compared there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

import cluster_est as ce
from cluster_est.config.build import build_problem
from cluster_est.config.reader import read_config

CONFIGS = Path(__file__).parents[2] / "configs"
CONFIG = CONFIGS / "mass_spring_damper.toml"
FMU = CONFIGS / "models" / "mass_spring_damper.fmu"
RTOL = 1e-8
"""Of adaptive steps in model exchange, for all: costs can be compared to 1e-6 then."""

Interface = Literal["co_simulation", "model_exchange"]
FMPY_NAMES = {"co_simulation": "CoSimulation", "model_exchange": "ModelExchange"}
TRUE_MASS = 1.2
"""kg; known in the smaller problem, where nothing in the data would tell it from the stiffness."""


@dataclass(frozen=True)
class Record:
    """One experiment.

    Attributes
    ----------
    times, force, measured : (n,)
        In s, N and m.
    values
        What is known of it: start values by variable.
    own
        The unknowns, by position, that have a meaning in it.
    """

    times: np.ndarray
    force: np.ndarray
    measured: np.ndarray
    values: dict[str, float]
    own: tuple[int, ...]


@dataclass(frozen=True)
class Case:
    """A problem, for this project and as plain numbers for the others."""

    title: str
    interface: Interface
    problem: ce.Problem
    unknowns: tuple[str, ...]
    start: tuple[float, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    records: tuple[Record, ...]

    def plain(self) -> dict[str, object]:
        """Give the first record as JSON, for a tool in an environment of its own."""
        record = self.records[0]
        return {
            "fmu": str(FMU),
            "interface": FMPY_NAMES[self.interface],
            "rtol": RTOL,
            "unknowns": list(self.unknowns),
            "start": list(self.start),
            "lower": list(self.lower),
            "upper": list(self.upper),
            "known": record.values,
            "times": record.times.tolist(),
            "force": record.force.tolist(),
            "measured": record.measured.tolist(),
        }


def embedded() -> Case:
    """Four experiments, three shared parameters and the initial position of one of them."""
    ids = ("exp1", "exp2", "exp3", "exp5")
    problem = read(ids, "co_simulation")
    records = [read_record(i, {"x": 0.0}, (0, 1, 2)) for i in ids[:-1]]
    records.append(read_record("exp5", {}, (0, 1, 2, 3)))
    return Case(
        "The embedded example: 4 experiments of 500 samples, 4 unknowns; co-simulation",
        "co_simulation",
        problem,
        ("m", "k", "c", "x"),
        (1.0, 25.0, 0.8, 0.0),
        (0.1, 1.0, 0.0, -1.0),
        (10.0, 200.0, 10.0, 1.0),
        tuple(records),
    )


def free_decay(interface: Interface) -> Case:
    """The one experiment without a force: what a tool without inputs, or for one record, can do."""
    starts = {"k": 25.0, "c": 0.8, "x": 0.1}
    problem = read(("exp5",), interface)
    parameters = [
        replace(p, start=TRUE_MASS, fixed=True)
        if p.name == "m"
        else replace(p, start=starts[p.variable or p.name])
        for p in problem.parameters
    ]
    return Case(
        f"Its experiment exp5 alone, a free decay: 500 samples, 3 unknowns; {interface}",
        interface,
        replace(problem, parameters=tuple(parameters)),
        tuple(starts),
        tuple(starts.values()),
        (1.0, 0.0, -1.0),
        (200.0, 10.0, 1.0),
        (read_record("exp5", {"m": TRUE_MASS}, (0, 1, 2)),),
    )


def read(ids: Sequence[str], interface: Interface) -> ce.Problem:
    """Some experiments of the example, with held inputs and no test among them."""
    held = [f'experiments.{i}.inputs.F={{ column = "force", interpolation = "hold" }}' for i in ids]
    overrides = [f"model.interface={interface}", "parameters.k.scale=linear", *held]
    if interface == "model_exchange":
        overrides.append(f"model.rtol={RTOL}")
    problem = build_problem(read_config(CONFIG, overrides), CONFIG.parent)
    kept = tuple(e for e in problem.experiments if e.id in ids)
    return replace(problem, experiments=kept)


def read_record(name: str, values: Mapping[str, float], own: tuple[int, ...]) -> Record:
    """Read a table of the example."""
    path = CONFIGS / "data" / "mass_spring_damper" / f"{name}.csv"
    times, force, measured = np.loadtxt(path, delimiter=",", skiprows=1).T
    return Record(times, force, measured, dict(values), own)
