"""Cases of the benchmark of gaps: a system, what is missing of which record, and the truth.

A case is deterministic: its number is the seed. Even numbers are open, odd ones are held back.
Rows are removed after the simulation, so that the model ran through every gap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from closed_loop_benchmark.system import Array, Run, System
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import simulate

Missing = Literal["rows", "cells", "outputs", "inputs"]
"""Rows that are not there, rows without any cell but the time, outputs alone, inputs alone."""
Decoy = Literal["", "jitter", "slow outputs", "irregular"]

CASES = 200
NAMES = (
    "mass_spring_damper", "pendulum", "dc_motor", "cascaded_tanks", "two_mass_drive",
    "thermal_two_node", "battery", "gantry_crane",
)  # fmt: skip
DECOYS: tuple[Decoy, ...] = ("", "", "", "jitter", "jitter", "slow outputs", "irregular")
MISSING: tuple[Missing, ...] = ("rows", "rows", "rows", "cells", "cells", "outputs", "inputs")
SHARES = (0.003, 0.01, 0.03)
"""Noise over the standard deviation of an output."""
FINER = 4
"""Steps of the simulation in an interval, on which samples may lie with jitter."""
SLOW = 8
"""Rows from one sample of a slow output to the next."""
PAUSE = 40
"""Rows of a rest in the middle of a record."""


@dataclass(frozen=True)
class Gap:
    """What is missing of a record from row `first` up to, not with, row `last`."""

    first: int
    last: int
    missing: Missing


@dataclass(frozen=True)
class Record:
    """A record as a logger has written it.

    Attributes
    ----------
    id
        Of the experiment.
    times : (rows,)
    inputs, outputs : (rows, inputs), (rows, outputs)
        NaN where a cell is empty.
    gaps : (gaps, 2)
        Times of the last row before each gap and of the first behind it.
    starts
        True initial states.
    """

    id: str
    times: Array = field(repr=False)
    inputs: Array = field(repr=False)
    outputs: Array = field(repr=False)
    gaps: tuple[tuple[float, float, Missing], ...]
    starts: Mapping[str, float]


@dataclass(frozen=True)
class Case:
    """Records of a system, and what an estimation is told."""

    number: int
    system: System
    held: bool
    decoy: Decoy
    share: float
    records: tuple[Record, ...]
    sigma: Array
    unknown: tuple[str, ...]
    starts: Mapping[str, float]
    guesses: Mapping[str, float]

    @property
    def name(self) -> str:
        kinds: list[str] = sorted({kind for record in self.records for *_, kind in record.gaps})
        told = ", ".join([*([self.decoy] if self.decoy else []), *kinds]) or "nothing"
        return f"{self.number:03d} {self.system.name}{' held' if self.held else ''}: {told}"


def make_case(number: int) -> Case:
    """Draw a case, simulate it and take away what is missing."""
    random = np.random.default_rng([20261129, number])
    system = SYSTEMS[NAMES[int(random.integers(len(NAMES)))]]
    held = bool(random.uniform() < 0.35)
    decoy = DECOYS[int(random.integers(len(DECOYS)))]
    share = SHARES[int(random.integers(len(SHARES)))]
    pause = bool(random.uniform() < 0.15)
    training = [r for r in system.excitation(system.times, random) if r.role == "train"]
    chosen = random.permutation(len(training))[: int(random.integers(1, 4))]
    runs = [training[i] for i in sorted(chosen.tolist())]
    gapless = bool(random.uniform() < 0.2)  # nothing is missing: nothing must be said
    parts = [
        _measure(system, run, decoy, random, held=held, pause=pause and i == 0)
        for i, run in enumerate(runs)
    ]
    sigma = share * np.concatenate([y for _, _, y in parts]).std(axis=0)
    records = []
    for i, (run, (times, inputs, outputs)) in enumerate(zip(runs, parts, strict=True)):
        noisy = outputs + sigma * random.normal(size=outputs.shape)
        hit = not gapless and (i == 0 or random.uniform() < 0.5)
        gaps = _draw(len(times), random, pause=pause and i == 0) if hit else ()
        records.append(_cut(f"run{i + 1}", times, inputs, noisy, gaps, decoy, run))
    own = system.unknown_starts
    spare = [s for s in system.states if s not in own]
    hidden = (*own, *spare[:1]) if random.uniform() < 0.3 else own
    starts = {
        name: value * (1.0 + 0.8 * system.spread(name) * random.uniform(-1.0, 1.0))
        for name, value in system.parameters.items()
    }
    guesses = {
        s: runs[0].starts[s] * (1.0 + system.start_error * random.uniform(-1.0, 1.0))
        for s in hidden
    }
    return Case(
        number, system, held, decoy, share, tuple(records), sigma, tuple(hidden), starts, guesses
    )


def _measure(
    system: System, run: Run, decoy: Decoy, random: np.random.Generator, *, held: bool, pause: bool
) -> tuple[Array, Array, Array]:
    """Return the times of the rows, the inputs there, and the outputs without noise."""
    samples = system.samples
    rows = FINER * np.arange(samples)
    if decoy == "jitter":
        rows[1:-1] += random.integers(-1, 2, samples - 2)
    if decoy == "irregular":  # a logger that skips rows now and then, two of three at most
        kept = random.uniform(size=samples) < 0.6
        kept[::3] = True
        rows = rows[kept]
    values = run.inputs[np.minimum(rows // FINER, samples - 1)].copy()
    if pause:
        values[_rest(len(rows))] = values[_rest(len(rows)).start]
    fine = np.arange(FINER * (samples - 1) + 1)
    finer = replace(system, interval=system.interval / FINER, samples=len(fine), substeps=3)
    if held:
        every = values[np.searchsorted(rows, fine, side="right") - 1]
    else:
        every = np.column_stack([np.interp(fine, rows, column) for column in values.T])
    signals = np.zeros((len(fine), len(system.signals)))
    found = (
        _simulate_held(finer, run, every, signals)
        if held
        else simulate(finer, [replace(run, inputs=every, signals=signals)])[0]
    )
    return np.asarray(rows * finer.interval), values, found[rows]


def _simulate_held(system: System, run: Run, inputs: Array, signals: Array) -> Array:
    """Simulate with inputs that keep their values from one sample to the next."""
    step = system.interval / system.substeps
    constants = [*system.parameters.values(), *system.constants.values()]
    x = np.array([run.starts[s] for s in system.states])
    found = np.empty((system.samples, len(system.outputs)))
    for n, u in enumerate(inputs):
        found[n] = system.readings(x, u, constants)
        for _ in range(system.substeps):
            k1 = np.array(system.rates(x, u, constants))
            k2 = np.array(system.rates(x + 0.5 * step * k1, u, constants))
            k3 = np.array(system.rates(x + 0.5 * step * k2, u, constants))
            k4 = np.array(system.rates(x + step * k3, u, constants))
            x = x + step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    return found


def _rest(rows: int) -> slice:
    middle = rows // 2
    return slice(middle - PAUSE, middle + PAUSE)


def _draw(rows: int, random: np.random.Generator, *, pause: bool) -> tuple[Gap, ...]:
    """Draw gaps that leave at least ten rows between them; one may be near either end."""
    if pause:
        middle = rows // 2
        return (Gap(middle - PAUSE // 2, middle + PAUSE // 2, "rows"),)
    free = np.ones(rows, dtype=bool)
    free[[0, -1]] = False
    found: list[Gap] = []
    for _ in range(int(random.integers(1, 4))):
        length = int(np.exp(random.uniform(np.log(10.0), np.log(0.22 * rows))))
        edge = random.uniform()
        first = int(random.integers(12, rows - length - 12))
        first = 3 if edge < 0.1 else rows - length - 3 if edge > 0.9 else first
        around = slice(max(first - 12, 1), min(first + length + 12, rows - 1))
        if not free[around].all():
            continue
        free[around] = False
        kind = MISSING[int(random.integers(len(MISSING)))]
        found.append(Gap(first, first + length, kind))
    return tuple(sorted(found, key=lambda gap: gap.first))


def _cut(
    id: str,
    times: Array,
    inputs: Array,
    outputs: Array,
    gaps: tuple[Gap, ...],
    decoy: Decoy,
    run: Run,
) -> Record:
    """Take away what is missing."""
    kept = np.ones(len(times), dtype=bool)
    inputs, outputs = inputs.copy(), outputs.copy()
    if decoy == "slow outputs":
        outputs[np.arange(len(times)) % SLOW != 0] = np.nan
    for gap in gaps:
        inside = slice(gap.first, gap.last)
        if gap.missing == "rows":
            kept[inside] = False
        if gap.missing in ("cells", "inputs"):
            inputs[inside] = np.nan
        if gap.missing in ("cells", "outputs"):
            outputs[inside] = np.nan
    said = tuple((float(times[gap.first - 1]), float(times[gap.last]), gap.missing) for gap in gaps)
    return Record(id, times[kept], inputs[kept], outputs[kept], said, run.starts)
