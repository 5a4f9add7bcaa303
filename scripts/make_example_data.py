"""Write the measurements of the examples: a mass on a spring, with and without dry friction, and a
spring with hysteresis.

The equations are implemented here independently of the FMU, and solved with a much tighter
tolerance. So an estimate from these data also checks the FMU. The noise is reproducible.

    python scripts/make_example_data.py
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

DATA = Path(__file__).resolve().parent.parent / "configs" / "data"
SEED = 20240

MASS, STIFFNESS, DAMPING = 1.2, 30.0, 0.6  # kg, N/m, N.s/m
SAMPLES, INTERVAL = 500, 0.02  # -, s
NOISE = 0.01  # standard deviation, relative to that of the position
FRICTION, SWITCH = 0.6, 0.002  # N, m/s: the dry friction is FRICTION * tanh(v / SWITCH)

AMPLITUDE, K_W, K_X = 1.02, 260.0, 190.0  # m, N, N/m; the angular frequency is 1 rad/s
RHO, SIGMA, N, W_0 = 2.1, 1.4, 1.5, -0.35  # 1/m, -, -, -
CYCLES, POINTS, AT_REST = 3, 50, 5  # -, per cycle, before the first cycle
SPRING_NOISE = {"Displacement": 0.002, "Force": 1.0}  # standard deviations in m and N

Array = NDArray[np.float64]
Waveform = Callable[[Array, np.random.Generator], Array]


def multisine(time: Array, random: np.random.Generator) -> Array:
    """Return a sum of sines from 0.2 Hz to 2 Hz with random phases."""
    frequencies = np.arange(0.2, 2.01, 0.2)
    phases = random.uniform(0.0, 2.0 * np.pi, frequencies.size)
    return np.asarray(np.sin(2.0 * np.pi * np.outer(time, frequencies) + phases).sum(axis=1))


def held_steps(time: Array, random: np.random.Generator) -> Array:
    """Return random levels, each held for 1.25 s."""
    levels = random.uniform(-6.0, 6.0, 8)
    return np.asarray(levels[(time // 1.25).astype(int)])


def chirp(time: Array, _: np.random.Generator) -> Array:
    """Return a sine that sweeps linearly from 0.1 Hz to 2 Hz."""
    duration = SAMPLES * INTERVAL
    return np.asarray(4.0 * np.sin(2.0 * np.pi * (0.1 + 0.95 * time / duration) * time))


def binary_sequence(time: Array, random: np.random.Generator) -> Array:
    """Return a pseudo-random binary sequence that may change every 0.3 s."""
    signs = random.choice([-3.0, 3.0], 40)
    return np.asarray(signs[(time // 0.3).astype(int)])


def no_force(time: Array, _: np.random.Generator) -> Array:
    """Return no force: the mass is released at rest."""
    return np.zeros_like(time)


EXPERIMENTS: list[tuple[Waveform, float]] = [  # waveform and initial position in m
    (multisine, 0.0),
    (held_steps, 0.0),
    (chirp, 0.0),
    (binary_sequence, 0.0),
    (no_force, 0.15),
]


RUBBING: list[tuple[Waveform, float]] = [  # experiments of the mass with dry friction
    (multisine, 0.0),
    (held_steps, 0.0),
    (binary_sequence, 0.0),
    (chirp, 0.0),
]


def positions(time: Array, force: Array, initial: float, friction: float = 0.0) -> Array:
    """Solve the equations of motion under a force that is linear between its samples.

    Parameters
    ----------
    time, force : ndarray
        The samples of the force.
    initial : float
        The initial position; the mass starts at rest.
    friction : float
        The dry friction in N.

    Returns
    -------
    ndarray
        The position at each time.
    """
    state, path = np.array([initial, 0.0]), [initial]
    for n in range(time.size - 1):  # the force has a kink at every sample

        def rate(t: float, x: Array, n: int = n) -> list[float]:
            applied = np.interp(t, time[n : n + 2], force[n : n + 2])
            applied -= friction * np.tanh(x[1] / SWITCH)
            return [x[1], (applied - STIFFNESS * x[0] - DAMPING * x[1]) / MASS]

        span = (time[n], time[n + 1])
        state = solve_ivp(rate, span, state, method="DOP853", rtol=1e-11, atol=1e-14).y[:, -1]
        path.append(state[0])
    return np.array(path)


def six_digits(values: Array) -> list[str]:
    """Write numbers with six significant digits."""
    return [f"{value:.6g}" for value in values]


def write(path: Path, columns: dict[str, list[str]]) -> None:
    """Write a table of texts as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def internal_displacement(time: Array) -> Array:
    """Solve the equation of the Bouc-Wen model from W_0, piecewise between its kinks.

    Parameters
    ----------
    time : ndarray
        Increasing from 0, under a displacement that is a sine of 1 rad/s.

    Returns
    -------
    ndarray
        W at each time.
    """

    def rate(t: float, w: Array) -> Array:
        velocity, size = AMPLITUDE * np.cos(t), np.abs(w)
        hysteresis = SIGMA * np.abs(velocity) * size ** (N - 1.0) * w
        return np.asarray(RHO * (velocity - hysteresis + (SIGMA - 1.0) * velocity * size**N))

    turns = np.pi * np.arange(0.5, time[-1] / np.pi)  # the velocity changes sign
    state, path = np.array([W_0]), [W_0]
    for first, last in pairwise([0.0, *turns, time[-1]]):
        wanted = time[(time > first) & (time <= last)]
        solution = solve_ivp(
            rate, (first, last), state, "DOP853", np.union1d(wanted, last), rtol=1e-11, atol=1e-13
        )
        path.extend(solution.y[0, : wanted.size])
        state = solution.y[:, -1]
    return np.array(path)


def hysteresis_loop() -> dict[str, Array]:
    """Return displacement and force of the spring, at rest, in its transient and in its loop.

    Samples at rest are needed because the noise of a single sample would determine whether the true
    curve begins beyond the end of the measured one. There, the nearest segment is on another
    branch.
    """
    time = np.linspace(0.0, 2.0 * np.pi * CYCLES, POINTS * CYCLES + 1)
    displacement = AMPLITUDE * np.sin(time)
    force = K_X * displacement + K_W * internal_displacement(time)
    curves = {"Displacement": displacement, "Force": force}
    return {name: np.append(np.full(AT_REST, v[0]), v) for name, v in curves.items()}


def write_masses() -> list[Path]:
    """Write the experiments on the mass, with and without dry friction, and return their paths."""
    return [
        *_write_mass("mass_spring_damper", EXPERIMENTS, 0.0, SEED),
        *_write_mass("mass_with_friction", RUBBING, FRICTION, SEED + 1),
    ]


def _write_mass(
    folder: str, experiments: Sequence[tuple[Waveform, float]], friction: float, seed: int
) -> list[Path]:
    paths = []
    time = np.round(INTERVAL * np.arange(SAMPLES), 2)
    for number, (waveform, initial) in enumerate(experiments, start=1):
        random = np.random.default_rng([seed, number])
        force_text = six_digits(waveform(time, random))
        true = positions(time, np.array(force_text, dtype=float), initial, friction)
        measured = true + random.normal(0.0, NOISE * true.std(), SAMPLES)
        columns = {"time": six_digits(time), "force": force_text, "position": six_digits(measured)}
        paths.append(DATA / folder / f"exp{number}.csv")
        write(paths[-1], columns)
    return paths


def write_spring() -> Path:
    """Write the curve of the spring with hysteresis, which has no times, and return its path."""
    random = np.random.default_rng(SEED)
    columns = {
        name: six_digits(true + random.normal(0.0, SPRING_NOISE[name], true.size))
        for name, true in hysteresis_loop().items()
    }
    path = DATA / "wen_bouc_spring.csv"
    write(path, columns)
    return path


def main() -> None:
    """Write all measurements and print their paths."""
    for path in (*write_masses(), write_spring()):
        print(path.relative_to(DATA.parents[1]).as_posix())


if __name__ == "__main__":
    main()
