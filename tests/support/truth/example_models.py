"""The example models' equations, written down again, and a solver that is slow but accurate.

Nothing of the project is used but its data classes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from workers.messages import Experiment, FloatArray, Input, Interpolation, Output

MODELS = Path(__file__).parents[3] / "configs" / "models"

Rates = Callable[[FloatArray, dict[str, float], dict[str, float]], list[float]]


@dataclass(frozen=True)
class Reference:
    """A model's equations and an experiment that moves it, all away from the FMU's own starts.

    Attributes
    ----------
    rates
        dx/dt of (x, inputs, parameters), the states in the order of `states`.
    inputs
        Mean and amplitude of each.
    outputs
        The state that each output shows.
    seconds
        How long an experiment takes.
    step
        Short enough for the classic Runge-Kutta method to reach a relative error of 1e-8.
    """

    rates: Rates
    parameters: dict[str, float]
    states: dict[str, float]
    inputs: dict[str, tuple[float, float]]
    outputs: dict[str, str]
    seconds: float
    step: float

    @property
    def starts(self) -> dict[str, float]:
        """All that an experiment sets."""
        return {**self.parameters, **self.states}


def mass(x: FloatArray, u: dict[str, float], p: dict[str, float]) -> list[float]:
    return [x[1], (u["F"] - p["k"] * x[0] - p["c"] * x[1]) / p["m"]]


def tanks(x: FloatArray, u: dict[str, float], p: dict[str, float]) -> list[float]:
    upper, lower = (p[k] * np.sqrt(max(h, 0.0)) for k, h in zip(("k1", "k2"), x, strict=True))
    return [p["kp"] * u["u"] - upper, upper - lower]


def motor(x: FloatArray, u: dict[str, float], p: dict[str, float]) -> list[float]:
    i, w, twist, w_load = x
    torque = p["k_belt"] * twist + p["d_belt"] * (w - w_load)
    return [
        (u["V"] - p["R"] * i - p["K"] * w) / p["L"],
        (p["K"] * i - p["b_motor"] * w - torque) / p["J_motor"],
        w - w_load,
        (torque - p["b_load"] * w_load - u["T_load"]) / p["J_load"],
    ]


def thermal(x: FloatArray, u: dict[str, float], p: dict[str, float]) -> list[float]:
    inner = (x[0] - x[1]) / p["R_core_case"]
    outer = (x[1] - u["T_ambient"]) / p["R_case_ambient"]
    return [(u["P"] - inner) / p["C_core"], (inner - outer) / p["C_case"]]


REFERENCES = {
    "mass_spring_damper": Reference(
        rates=mass,
        parameters={"m": 1.3, "k": 31.0, "c": 0.7},
        states={"x": 0.1, "v": -0.2},
        inputs={"F": (1.0, 4.0)},
        outputs={"y": "x"},
        seconds=3.0,
        step=2e-3,
    ),
    "cascaded_tanks": Reference(
        rates=tanks,
        parameters={"k1": 0.06, "k2": 0.045, "kp": 0.055},
        states={"h1": 3.0, "h2": 5.0},
        inputs={"u": (3.0, 2.0)},
        outputs={"y": "h2"},
        seconds=300.0,
        step=0.2,
    ),
    "dc_motor_belt": Reference(
        rates=motor,
        parameters={
            "R": 1.2,
            "L": 6e-3,
            "K": 0.06,
            "J_motor": 1.2e-4,
            "b_motor": 3e-5,
            "k_belt": 2.4,
            "d_belt": 4e-3,
            "J_load": 6e-4,
            "b_load": 2e-4,
        },
        states={"i": 0.5, "w_motor": 20.0, "twist": 0.01, "w_load": 18.0},
        inputs={"V": (6.0, 6.0), "T_load": (0.05, 0.02)},
        outputs={"load_speed": "w_load", "current": "i", "speed": "w_motor"},
        seconds=0.2,
        step=5e-5,
    ),
    "thermal_two_node": Reference(
        rates=thermal,
        parameters={"C_core": 70.0, "C_case": 180.0, "R_core_case": 1.7, "R_case_ambient": 3.5},
        states={"T_core": 40.0, "T_case": 30.0},
        inputs={"P": (8.0, 5.0), "T_ambient": (20.0, 5.0)},
        outputs={"y_core": "T_core", "y_case": "T_case"},
        seconds=600.0,
        step=0.5,
    ),
}


def sampled_experiment(
    reference: Reference, interpolation: Interpolation, seed: int = 0, start: float | None = None
) -> Experiment:
    """Every input and every output at irregular times of its own, in `reference.seconds`."""
    generator = np.random.default_rng(seed)
    length = reference.seconds
    start = 0.4 * length if start is None else start
    inputs = []
    for place, (name, (mean, amplitude)) in enumerate(reference.inputs.items()):
        # some samples before the start, and no more long before the end
        times = np.sort(generator.uniform(-0.1, 0.8 + 0.1 * place, 25 + 9 * place))
        values = mean + amplitude * np.sin(9.0 * times + place)
        inputs.append(Input(name, start + length * times, values, interpolation))
    outputs = []
    for place, name in enumerate(reference.outputs):
        times = np.sort(generator.uniform(0.0, 1.0, 30 + 7 * place))
        outputs.append(Output(name, start + length * times, np.zeros(len(times))))
    return Experiment(
        "sampled",
        start,
        start + length,
        tuple(inputs),
        tuple(outputs),
        tuple(reference.starts.items()),
    )


def solve(reference: Reference, experiment: Experiment, at: FloatArray) -> FloatArray:
    """(times, outputs): the outputs at some times, solved anew from each kink of an input."""
    kinks = np.concatenate([[experiment.start], *(g.times for g in experiment.inputs), [at[-1]]])
    kinks = np.unique(kinks[(kinks >= experiment.start) & (kinks <= at[-1])])
    names = list(reference.states)
    x = np.array(list(reference.states.values()))
    found = np.empty((len(at), len(names)))
    found[at == experiment.start] = x
    for first, last in pairwise(kinks):
        inside = (at > first) & (at <= last)
        result = solve_ivp(
            _rates_between(reference, experiment, first, last),
            (first, last),
            x,
            method="DOP853",
            t_eval=np.unique([*at[inside], last]),
            rtol=1e-12,
            atol=1e-13,
        )
        found[inside] = result.y[:, : inside.sum()].T
        x = result.y[:, -1]
    return found[:, [names.index(state) for state in reference.outputs.values()]]


def _rates_between(
    reference: Reference, experiment: Experiment, first: float, last: float
) -> Callable[[float, FloatArray], list[float]]:
    """Rates with each input on its own branch: a straight line, or its value after `first`."""
    lines = {}
    for given in experiment.inputs:
        if given.interpolation == "hold":
            line = (held(given, first), 0.0)
        else:
            ends = np.interp([first, last], given.times, given.values)
            line = (ends[0], (ends[1] - ends[0]) / (last - first))
        lines[given.variable] = line

    def rates(t: float, x: FloatArray) -> list[float]:
        u = {name: value + (t - first) * slope for name, (value, slope) in lines.items()}
        return reference.rates(x, u, reference.parameters)

    return rates


def held(given: Input, at: float) -> float:
    before = given.values[given.times <= at]
    return float(before[-1] if len(before) else given.values[0])
