"""Multiple shooting beside fits of whole records, on models that are chaotic or unstable.

A double pendulum and Chua's circuit are chaotic; an inverted pendulum on a cart is unstable, and
what is known is the force that its controller has put out. The data are SciPy's solutions of the
equations that the tests compare the FMUs with, with noise of 1 % of each output's spread. Each of
the `starts` has every parameter at half or at one and a half times its true value, drawn at random;
`only` chooses systems, and with `single` whole records are fitted, too. Recovered: every parameter
within four of its standard errors, none of which is above 5 %.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are
from support.truth.example_models import REFERENCES

import cluster_est as ce
from benches import Row
from benches.common import MODELS, Array

NOISE = 0.01
MOST = 0.05


@dataclass(frozen=True)
class Record:
    """A record of a system: when, what drove it, and what it did without noise."""

    times: Array
    inputs: dict[str, Array]
    outputs: dict[str, Array]


@dataclass(frozen=True)
class System:
    """A model with its true parameters, and the states that it is simulated from.

    `states` has for each state the output that measures it; "" where none does.
    """

    fmu: str
    parameters: dict[str, float]
    states: dict[str, str]
    segments: int
    record: Callable[[np.random.Generator], Record]


def double_pendulum(generator: np.random.Generator) -> Record:
    """Two rods that swing freely, far from hanging."""
    times = np.arange(0.0, 10.001, 0.01)
    begin = np.array([2.0, 2.5, 0.0, 0.0]) + generator.uniform(-0.3, 0.3, 4)
    path = _solve(_rates("double_pendulum", 1.0, 0.7, 1.0, 0.8, 9.81), times, begin)
    return Record(times, {}, {"y1": path[0], "y2": path[1]})


def chua_circuit(generator: np.random.Generator) -> Record:
    """On its attractor."""
    rate = _rates("chua_circuit", 15.6, 28.0, -1.143, -0.714)
    times = np.arange(0.0, 50.001, 0.05)
    begin = np.array([0.5, 0.0, 0.0]) + generator.uniform(-0.1, 0.1, 3)
    settled = solve_ivp(rate, (0.0, 20.0), begin, rtol=1e-9, atol=1e-11).y[:, -1]
    path = _solve(rate, times, settled)
    return Record(times, {}, {"v1": path[0], "v2": path[1]})


def cart_pendulum(generator: np.random.Generator) -> Record:
    """Under linear feedback of all states, sampled and held; a reference keeps it moving."""

    def rate(z: Array, force: float) -> Array:
        return _rates("cart_pendulum", 1.0, 0.3, 0.5, 0.5, 0.01, 9.81, force=force)(0.0, z)

    step, small = 0.01, 1e-6
    linear = np.column_stack(
        [(rate(small * e, 0.0) - rate(-small * e, 0.0)) / (2.0 * small) for e in np.eye(4)]
    )
    control = (rate(np.zeros(4), small) - rate(np.zeros(4), -small))[:, None] / (2.0 * small)
    cost = solve_continuous_are(linear, control, np.diag([10.0, 10.0, 1.0, 1.0]), np.eye(1))
    gain = (control.T @ cost)[0]
    times = np.arange(0.0, 10.0 + step / 2.0, step)
    phases = generator.uniform(0.0, 2.0 * np.pi, 3)
    z = np.concatenate([generator.uniform(-0.1, 0.1, 2), np.zeros(2)])
    path, forces = [z], []
    for t in times[:-1]:
        waves = np.sin(np.array([1.1, 2.9, 5.3]) * t + phases)
        wanted = np.array([0.3 * waves.sum(), 0.0, 0.0, 0.0])
        force = float(-gain @ (z - wanted))
        forces.append(force)
        z = solve_ivp(lambda _, s, f=force: rate(s, f), (0.0, step), z, rtol=1e-10, atol=1e-12).y[
            :, -1
        ]
        path.append(z)
    seen = np.array(path).T
    return Record(times, {"F": np.array([*forces, forces[-1]])}, {"y1": seen[0], "y2": seen[1]})


def _rates(model: str, *parameters: float, force: float = 0.0) -> Callable[[float, Array], Array]:
    rates = REFERENCES[model].rates
    return lambda _, z: np.array(rates(z, [force], [*parameters]))


def _solve(rate: Callable[[float, Array], Array], times: Array, begin: Array) -> Array:
    span = (times[0], times[-1])
    found = solve_ivp(rate, span, begin, "DOP853", t_eval=times, rtol=1e-11, atol=1e-12)
    return np.asarray(found.y)


SYSTEMS = {
    "double_pendulum": System(
        "double_pendulum.fmu",
        {"m2": 0.7, "l1": 1.0, "l2": 0.8},
        {"angle1": "y1", "angle2": "y2", "speed1": "", "speed2": ""},
        20,
        double_pendulum,
    ),
    "chua_circuit": System(
        "chua_circuit.fmu",
        {"alpha": 15.6, "beta": 28.0, "a": -1.143, "b": -0.714},
        {"x": "v1", "y": "v2", "z": ""},
        50,
        chua_circuit,
    ),
    "cart_pendulum": System(
        "cart_pendulum.fmu",
        {"m_cart": 1.0, "m_rod": 0.3, "l": 0.5, "b": 0.5, "d": 0.01},
        {"position": "y1", "angle": "y2", "velocity": "", "speed": ""},
        20,
        cart_pendulum,
    ),
}


def made_problem(system: System, seed: int) -> ce.Problem:
    """One record with noise, and a start that is half off in each parameter."""
    generator = np.random.default_rng(seed)
    record = system.record(generator)
    outputs = []
    first = {}
    for name, values in record.outputs.items():
        sigma = NOISE * float(np.std(values))
        noisy = values + sigma * generator.normal(size=len(values))
        first[name] = float(noisy[0])
        outputs.append(ce.Output(name, record.times, noisy, sigma=sigma))
    inputs = tuple(ce.Input(n, record.times, v, "hold") for n, v in record.inputs.items())
    times = record.times
    experiment = ce.Experiment("record", times[0], times[-1], inputs, tuple(outputs))
    parameters = [
        ce.Parameter(
            name,
            true * generator.choice([0.5, 1.5]),
            bounds=(min(0.05 * true, 20.0 * true), max(0.05 * true, 20.0 * true)),
        )
        for name, true in system.parameters.items()
    ]
    parameters += [
        ce.Parameter(f"{state}0", first.get(output, 0.0), variable=state)
        for state, output in system.states.items()
    ]
    model = ce.read_model(MODELS / system.fmu)
    return ce.Problem(model, tuple(parameters), (experiment,))


MEDIANS = ("cost a sample", "worst error", "simulations", "seconds")
OPTIONS = {"starts": 40, "only": list(SYSTEMS), "single": False}


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each system and way."""
    for name in options.only:
        system = SYSTEMS[name]
        ways: dict[str, int | None] = {"segments": system.segments}
        ways |= {"whole": None} if options.single else {}
        for way, segments in ways.items():
            trials = [trial(system, seed, segments) for seed in range(options.starts)]
            yield {
                "system": name,
                "way": way,
                "recovered": sum(bool(each["recovered"]) for each in trials),
                "of": len(trials),
                "joined": sum(bool(each["joined"]) for each in trials),
                **{k: float(np.median([float(each[k]) for each in trials])) for k in MEDIANS},
            }


def trial(system: System, seed: int, segments: int | None) -> Row:
    """The end of a fit from one start, in segments or not."""
    problem = made_problem(system, seed)
    begin = time.monotonic()
    result = ce.fit(problem, shooting=None if segments is None else {"segments": segments})
    seconds = time.monotonic() - begin
    values = {e.label: e for e in result.estimates}
    pairs = [(values[name], true) for name, true in system.parameters.items()]
    widest = max(found.std_error / abs(true) for found, true in pairs)
    within = max(
        abs(found.value - true) / found.std_error if found.std_error > 0.0 else np.inf
        for found, true in pairs
    )
    return {
        "recovered": bool(widest < MOST and within < 4.0),
        "joined": result.shooting is not None and bool(result.shooting.joined),
        "cost a sample": result.cost / problem.experiments[0].size,
        "worst error": max(abs(found.value / true - 1.0) for found, true in pairs),
        "simulations": result.simulated,
        "seconds": seconds,
    }
