"""Waveforms of about unit amplitude, as functions of the sampling times."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark.system import Array

Random = np.random.Generator


def multisine(time: Array, random: Random, low: float, high: float, lines: int = 12) -> Array:
    """Return a sum of sines from `low` to `high` hertz with random phases."""
    frequencies = np.linspace(low, high, lines)
    phases = random.uniform(0.0, 2.0 * np.pi, lines)
    waves = np.sin(2.0 * np.pi * np.outer(time, frequencies) + phases)
    return np.asarray(waves.sum(axis=1) * np.sqrt(2.0 / lines) / 1.5)


def held(time: Array, random: Random, hold: float) -> Array:
    """Return random levels between -1 and 1, each held for `hold` seconds."""
    return np.asarray(random.uniform(-1.0, 1.0, _pieces(time, hold))[_piece(time, hold)])


def binary(time: Array, random: Random, hold: float) -> Array:
    """Return a random sequence of -1 and 1 that may change every `hold` seconds."""
    return np.asarray(random.choice([-1.0, 1.0], _pieces(time, hold))[_piece(time, hold)])


def ramps(time: Array, random: Random, hold: float) -> Array:
    """Return straight lines between random levels, `hold` seconds apart."""
    levels = random.uniform(-1.0, 1.0, _pieces(time, hold) + 1)
    return np.asarray(np.interp(time, hold * np.arange(levels.size), levels))


def chirp(time: Array, low: float, high: float) -> Array:
    """Return a sine whose frequency grows linearly from `low` to `high` hertz."""
    rate = (high - low) / (2.0 * time[-1])
    return np.asarray(np.sin(2.0 * np.pi * (low + rate * time) * time))


def triangle(time: Array, period: float) -> Array:
    """Return a triangular wave that starts at zero and rises."""
    return np.asarray(2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * time / period)))


def noise(time: Array, random: Random, cutoff: float) -> Array:
    """Return smooth noise, clipped: white noise through two low passes at `cutoff` hertz."""
    keep = np.exp(-2.0 * np.pi * cutoff * (time[1] - time[0]))
    wave = random.normal(size=time.size)
    for _ in range(2):
        for n in range(1, wave.size):
            wave[n] = keep * wave[n - 1] + (1.0 - keep) * wave[n]
    return np.asarray(np.clip(wave / wave.std() / 1.5, -1.8, 1.8))


def daylight(time: Array, random: Random) -> Array:
    """Return the strength of the sun from 0 to 1: half a sine each day, reduced by clouds."""
    sun = np.maximum(np.sin(2.0 * np.pi * (time / 86400.0 - 0.25)), 0.0)
    return np.asarray(sun * (0.6 + 0.4 * ramps(time, random, 7200.0)))


def _piece(time: Array, hold: float) -> np.ndarray:
    # shifted by half a sample, so that rounding does not move an edge
    return np.asarray((time + 0.5 * (time[1] - time[0])) // hold, dtype=int)


def _pieces(time: Array, hold: float) -> int:
    return int(time[-1] / hold) + 2
