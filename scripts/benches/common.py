"""What benches share: where things are, timing by turns, problems, FMUs made from equations."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from build_fmus import build
from numpy.typing import NDArray

import cluster_est as ce
from cluster_est.config.build import build_problem
from cluster_est.config.reader import read_config

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
MODELS = CONFIGS / "models"
EXAMPLES = ("mass_spring_damper", "mass_with_friction", "cascaded_tanks")
"""Configs of examples whose data are in the repository."""


def example(name: str) -> ce.Problem:
    """The problem of an example, by the name of its config."""
    return build_problem(read_config(CONFIGS / f"{name}.toml"), CONFIGS)


def by_turns(runs: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each run, all of them by turns.

    Each has run once before: the first run fills caches.
    """
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(rounds):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begin)
    return {name: statistics.median(each) for name, each in seconds.items()}


def searches_by_turns(
    ways: Mapping[str, Callable[[], ce.Result]], rounds: int
) -> dict[str, tuple[float, ce.Result]]:
    """Median seconds of the searches of fits, all of them by turns, and the last results."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    found: dict[str, ce.Result] = {}
    for turn in range(rounds + 1):
        for name, fit in ways.items():
            found[name] = fit()
            if turn > 0:  # the first fills caches
                seconds[name].append(found[name].search_seconds)
    return {name: (statistics.median(each), found[name]) for name, each in seconds.items()}


@dataclass(frozen=True)
class WrittenModel:
    """A model as equations in C, of which an FMU is made.

    Attributes
    ----------
    parameters
        Their start values.
    inputs, states, outputs
        Names; an output "y_X" shows the state X.
    equations
        As `name = expression`, one for each derivative "der_X".
    stop, step, max_step
        Of the default experiment, and of the integration inside.
    """

    name: str
    parameters: Mapping[str, float]
    inputs: Sequence[str]
    states: Sequence[str]
    outputs: Sequence[str]
    equations: Iterable[str]
    stop: float
    step: float
    max_step: float

    def build(self, folder: Path) -> Path:
        """Write the sources into a folder, compile them, and give the FMU."""
        own = folder / self.name
        own.mkdir()
        entries = [f'description = "{self.name}"', f"max_step = {self.max_step}", "[experiment]"]
        entries += [f"stop = {self.stop}", f"step = {self.step}", "[units]", '"1" = {}']

        def variable(name: str, causality: str, *more: str) -> None:
            entries.extend(["[[variable]]", f'name = "{name}"', f'causality = "{causality}"'])
            entries.extend(['unit = "1"', *more])

        for name, value in self.parameters.items():
            variable(name, "parameter", 'variability = "tunable"', f"start = {value}")
        for name in self.inputs:
            variable(name, "input", "start = 0.0")
        for name in self.states:
            rate = f'derivative = {{ name = "der({name})", unit = "1" }}'
            variable(name, "local", rate, "start = 0.0")
        for name in self.outputs:
            variable(f"y_{name}", "output")
        pairs = [each.partition(" = ") for each in self.equations]
        lines = [f"    M({left}) = {right};" for left, _, right in pairs]
        lines += [f"    M(y_{name}) = M({name});" for name in self.outputs]
        head = '#include <math.h>\n\n#include "fmi2_model.h"\n\n'
        body = "fmi2Status model_equations(Model *m)\n{\n" + "\n".join(lines)
        (own / "model.c").write_text(f"{head}{body}\n    return fmi2OK;\n}}\n", "utf-8")
        (own / "model.toml").write_text("\n".join(entries) + "\n", "utf-8")
        return build(own, folder)
