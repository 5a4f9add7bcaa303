"""Cases of the benchmark of faults of records: a healthy set, and what is made wrong in it.

A case is deterministic: its number is the seed. Of each kind the cases with even numbers are open,
those with odd ones held back. Each fault is so large that the output which shows it most is off by
`VISIBLE` times its noise, root mean square over the record, or more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from closed_loop_benchmark.data import Data, Experiment, make
from closed_loop_benchmark.scenarios import COLOURED, WHITE, scenario, singles
from closed_loop_benchmark.system import Array, Run, System
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import Push, simulate
from scipy.interpolate import CubicSpline

Kind = Literal[
    "gain",
    "offset",
    "delay",
    "sign",
    "swapped",
    "clock",
    "unit",
    "sentinel",
    "foreign",
    "transient",
    "evidence",
]
"""What is wrong. "evidence": peaks that follow an input, and are no outliers. Nothing is wrong."""
KINDS: tuple[Kind, ...] = get_args(Kind)
OF_EACH, CLEAN, MISSING = 4, 100, 20
"""Cases of each kind, sets without any fault, and such sets whose model lacks an effect."""
VISIBLE = 6.0
TRIES = 200

UNITS: tuple[tuple[str, str, float, float], ...] = (
    ("pendulum", "y", 180.0 / np.pi, 0.0),
    ("dc_motor", "speed", 30.0 / np.pi, 0.0),
    ("stirred_tank_reactor", "temperature", 1.0, -273.15),
    ("two_mass_drive", "load_speed", 30.0 / np.pi, 0.0),
    ("gantry_crane", "angle", 180.0 / np.pi, 0.0),
    ("quarter_car", "travel", 1000.0, 0.0),
    ("hydraulic_cylinder", "pressure", 1000.0, 0.0),
    ("kiln", "charge", 1.8, 32.0),
    ("battery", "current", 1000.0, 0.0),
    ("resonant_circuit", "e", 1000.0, 0.0),
    ("mass_spring_damper", "F", 1.0 / 9.80665, 0.0),
    ("cascaded_tanks", "y", 100.0, 0.0),
)
"""System, variable, and what the column has: factor and offset. Degrees, 1/min, degC for K, mm,
mbar for bar, degF for degC, mA, mV, kilopond, percent."""
SENTINELS = (-9999.0, 65535.0, 9.9e37, -999.25)
PEAKED = ("mass_spring_damper", "kiln", "chemostat", "two_mass_drive")
"""Systems of the cases of evidence."""


@dataclass(frozen=True)
class Case:
    """A set of records.

    Attributes
    ----------
    number, name, kind
        Its number, what it is called, and what is wrong; "" for nothing.
    data
        As a method is given it.
    record
        Index of the record that is wrong; -1 for none, or for all.
    variable
        What is wrong in it; "" for several.
    size
        A gain, an offset, a delay in seconds or a frequency.
    held_back
        Nothing may be tuned on it.
    """

    number: int
    name: str
    kind: Kind | Literal[""]
    data: Data
    record: int = -1
    variable: str = ""
    size: float = np.nan
    held_back: bool = False


def make_fault(number: int) -> Case:
    """Draw a case with a fault: 0 to `OF_EACH` * len(KINDS) - 1."""
    kind, repeat = KINDS[number % len(KINDS)], number // len(KINDS)
    for attempt in range(TRIES):
        random = np.random.default_rng([61_008, number, attempt])
        case = _MAKERS[kind](number, kind, repeat, random)
        if case is not None:
            return replace(case, held_back=repeat % 2 == 1)
    raise AssertionError(f"case {number}: no draw of {TRIES} is visible")


def make_clean(number: int) -> Case:
    """Draw a set in which nothing is wrong and nothing is missing: 0 to `CLEAN` - 1."""
    system = sorted(SYSTEMS)[number % len(SYSTEMS)]
    noise = (*WHITE, *COLOURED)[number // len(SYSTEMS) % 4]
    case = scenario(system, "clean", f"healthy records {number}", noise)
    return Case(number, f"clean {number} {system}", "", make(case), held_back=number % 2 == 1)


def make_missing(number: int) -> Case:
    """Draw a set without a fault whose model lacks an effect: 0 to `MISSING` - 1."""
    cases = [each for each in singles((0.25, 1.0)) if each.system != "battery"]
    chosen = np.random.default_rng(61_009).permutation(len(cases))[:MISSING]
    case = cases[chosen[number]]
    return Case(number, f"effect {number} {case.name}", "", make(case), held_back=number % 2 == 1)


def _healthy(system: str, number: int, random: np.random.Generator) -> Data:
    noise = WHITE[int(random.integers(2))]
    made = scenario(system, "clean", f"records {number}", noise)
    return make(replace(made, seed=int(random.integers(2**31))))


def _drawn_system(
    random: np.random.Generator, least_inputs: int = 1, least_outputs: int = 1
) -> str:
    names = [
        name
        for name, each in sorted(SYSTEMS.items())
        if len(each.inputs) >= least_inputs and len(each.outputs) >= least_outputs
    ]
    return names[int(random.integers(len(names)))]


def _training(data: Data) -> list[int]:
    return [n for n, each in enumerate(data.experiments) if each.role == "train"]


def _with(data: Data, record: int, changed: Experiment) -> Data:
    runs = tuple(changed if n == record else each for n, each in enumerate(data.experiments))
    return replace(data, experiments=runs)


def _changed(data: Data, record: int, variable: str, column: Array) -> Data:
    """Put another column in the place of one of a record."""
    system, run = data.system, data.experiments[record]
    if variable in system.inputs:
        inputs = run.inputs.copy()
        inputs[:, system.inputs.index(variable)] = column
        return _with(data, record, replace(run, inputs=inputs))
    outputs = run.outputs.copy()
    outputs[:, system.outputs.index(variable)] = column
    return _with(data, record, replace(run, outputs=outputs))


def _column(data: Data, record: int, variable: str) -> Array:
    system, run = data.system, data.experiments[record]
    if variable in system.inputs:
        return run.inputs[:, system.inputs.index(variable)]
    return run.outputs[:, system.outputs.index(variable)]


def _visible(before: Data, after: Data, record: int) -> bool:
    """Whether what the record says of its own system is off by enough.

    The outputs are compared with those that the system has with the inputs that the record shows.
    """
    shown, system = after.experiments[record], before.system
    own = before.experiments[record]
    run = Run(own.waveform, own.role, shown.inputs, own.true_starts, shown.signals)
    (answer,) = simulate(system, [run])
    change = shown.outputs - own.outputs + own.true_outputs - answer
    with np.errstate(over="ignore"):
        sizes = np.sqrt(np.mean(change**2, axis=0)) / before.sigma
    return bool(np.isfinite(sizes).all() and sizes.max() > VISIBLE)


def _one_column(number: int, kind: Kind, repeat: int, random: np.random.Generator) -> Case | None:
    """A gain, an offset, a delay or a sign of one column of one record."""
    system = _drawn_system(random)
    healthy = _healthy(system, number, random)
    record = int(random.choice(_training(healthy)))
    sort = healthy.system.inputs if random.uniform() < 0.4 else healthy.system.outputs
    variable = str(random.choice(sort))
    values = _column(healthy, record, variable)
    if not np.ptp(values) > 0.0:
        return None
    size = -1.0
    if kind == "gain":
        size = float(
            random.uniform(0.6, 0.85) if random.uniform() < 0.5 else random.uniform(1.2, 1.6)
        )
    elif kind == "offset":
        size = float(random.choice([-1.0, 1.0]) * random.uniform(0.2, 0.8) * np.std(values))
    elif kind == "delay":
        size = float(random.uniform(2.0, 8.0) * healthy.system.interval)
    if kind == "offset":
        column = values + size
    elif kind == "delay":
        column = _late(healthy, record, variable, size)
    else:
        column = size * values
    changed = _changed(healthy, record, variable, column)
    if not _visible(healthy, changed, record):
        return None
    return Case(
        number, _name(number, kind, system, variable), kind, changed, record, variable, size
    )


def _late(data: Data, record: int, variable: str, delay: float) -> Array:
    """A column that is written late; its noise is not smoothed."""
    system, run = data.system, data.experiments[record]
    if variable in system.inputs:
        column = run.inputs[:, system.inputs.index(variable)]
        return np.asarray(np.interp(data.driven - delay, data.driven, column))
    place = system.outputs.index(variable)
    true = run.true_outputs[:, place]
    late = CubicSpline(data.times, true)(np.maximum(data.times - delay, data.times[0]))
    return np.asarray(late + run.outputs[:, place] - true)


def _swapped(number: int, kind: Kind, repeat: int, random: np.random.Generator) -> Case | None:
    """Two inputs or two outputs in each other's place, in one record."""
    inputs = random.uniform() < 0.4
    system = _drawn_system(random, 2 if inputs else 1, 1 if inputs else 2)
    healthy = _healthy(system, number, random)
    record = int(random.choice(_training(healthy)))
    names = healthy.system.inputs if inputs else healthy.system.outputs
    one, other = (str(name) for name in random.permutation(names)[:2])
    first, second = (_column(healthy, record, name).copy() for name in (one, other))
    changed = _changed(_changed(healthy, record, one, second), record, other, first)
    if not _visible(healthy, changed, record):
        return None
    return Case(number, _name(number, kind, system, f"{one} and {other}"), kind, changed, record)


def _clock(number: int, kind: Kind, repeat: int, random: np.random.Generator) -> Case | None:
    """All outputs equally late: in one record, or in all."""
    system = _drawn_system(random, 1, 2)
    healthy = _healthy(system, number, random)
    record = int(random.choice(_training(healthy)))
    delay = float(random.uniform(2.0, 8.0) * healthy.system.interval)
    which = range(len(healthy.experiments)) if repeat >= 2 else [record]
    changed = healthy
    for each in which:
        for name in healthy.system.outputs:
            changed = _changed(changed, each, name, _late(healthy, each, name, delay))
    if not all(_visible(healthy, changed, each) for each in which):
        return None
    everywhere = repeat >= 2
    name = _name(number, kind, system, "all records" if everywhere else "one record")
    return Case(number, name, kind, changed, -1 if everywhere else record, "", delay)


def _unit(number: int, kind: Kind, repeat: int, random: np.random.Generator) -> Case | None:
    """A column in another unit: in one record, or in all."""
    system, variable, factor, offset = UNITS[int(random.integers(len(UNITS)))]
    healthy = _healthy(system, number, random)
    record = int(random.choice(_training(healthy)))
    everywhere = repeat >= 2
    if not np.ptp(_column(healthy, record, variable)) > 0.0:
        return None
    changed = healthy
    for each in range(len(healthy.experiments)) if everywhere else [record]:
        column = factor * _column(healthy, each, variable) + offset
        changed = _changed(changed, each, variable, column)
    if everywhere and variable in healthy.system.outputs:
        place = healthy.system.outputs.index(variable)
        sigma = changed.sigma.copy()
        sigma[place] *= factor  # who writes a column in another unit writes its noise in it too
        changed = replace(changed, sigma=sigma)
    name = _name(
        number, kind, system, f"{variable}, {'all records' if everywhere else 'one record'}"
    )
    return Case(number, name, kind, changed, -1 if everywhere else record, variable, factor)


def _sentinel(number: int, kind: Kind, repeat: int, random: np.random.Generator) -> Case | None:
    """A number that stands for no measurement, in 3 to 8 samples of an output."""
    system = _drawn_system(random)
    healthy = _healthy(system, number, random)
    record = int(random.choice(_training(healthy)))
    variable = str(random.choice(healthy.system.outputs))
    value = SENTINELS[repeat]
    column = _column(healthy, record, variable).copy()
    if np.ptp(column) > 0.2 * abs(value):
        return None
    first = int(random.integers(5, len(column) - 20))
    count = int(random.integers(3, 9))
    scattered = random.permutation(len(column) - 2)[:count] + 1
    column[scattered if random.uniform() < 0.5 else slice(first, first + count)] = value
    changed = _changed(healthy, record, variable, column)
    return Case(
        number, _name(number, kind, system, variable), kind, changed, record, variable, value
    )


def _foreign(number: int, kind: Kind, repeat: int, random: np.random.Generator) -> Case | None:
    """A sine that nobody measured, of another frequency in each record: at an output, or inside."""
    system_name = _drawn_system(random)
    healthy = _healthy(system_name, number, random)
    system, times = healthy.system, healthy.times
    duration = float(times[-1])
    centre = np.exp(random.uniform(np.log(10.0 / duration), np.log(0.1 / system.interval)))
    spread = random.permutation(np.linspace(0.85, 1.15, len(healthy.experiments)))
    phases = random.uniform(0.0, 2.0 * np.pi, len(spread))
    waves = [
        np.sin(2.0 * np.pi * centre * f * times + p) for f, p in zip(spread, phases, strict=True)
    ]
    runs = [
        Run(e.waveform, e.role, e.inputs, e.true_starts, e.signals) for e in healthy.experiments
    ]
    if repeat < 2:
        place = int(random.integers(len(system.outputs)))
        parts = [np.zeros_like(e.outputs) for e in healthy.experiments]
        for part, wave in zip(parts, waves, strict=True):
            part[:, place] = np.sqrt(2.0) * random.uniform(6.0, 12.0) * healthy.sigma[place] * wave
    else:
        state = str(random.choice(system.states))
        parts = _pushed(system, runs, state, waves, healthy.sigma, random.uniform(8.0, 14.0))
    if not parts or not all(np.isfinite(part).all() for part in parts):
        return None
    changed = healthy
    for n, (each, part) in enumerate(zip(healthy.experiments, parts, strict=True)):
        sizes = np.sqrt(np.mean(part**2, axis=0)) / healthy.sigma
        if each.role == "train" and not sizes.max() > 0.5 * VISIBLE:
            return None
        changed = _with(changed, n, replace(each, outputs=each.outputs + part))
    where = "at an output" if repeat < 2 else "inside"
    return Case(number, _name(number, kind, system_name, where), kind, changed, size=float(centre))


def _pushed(
    system: System,
    runs: Sequence[Run],
    state: str,
    waves: Sequence[Array],
    sigma: Array,
    size: float,
) -> list[Array]:
    """What a push on a rate changes at the outputs, so large in their noise."""
    signal, nothing = np.column_stack(list(waves)), simulate(system, runs)
    scale = 1e-6
    for _ in range(3):  # the answer need not be in proportion
        with np.errstate(all="ignore"):
            found = simulate(system, runs, pushes=[Push(state, scale * signal)])
        parts = [y - none for y, none in zip(found, nothing, strict=True)]
        reached = max(float((np.sqrt(np.mean(p**2, axis=0)) / sigma).max()) for p in parts)
        if not np.isfinite(reached) or not reached > 0.0:
            return []
        scale *= size / reached
    return parts


def _transient(number: int, kind: Kind, repeat: int, random: np.random.Generator) -> Case | None:
    """One record begins elsewhere than it says."""
    system_name = _drawn_system(random)
    healthy = _healthy(system_name, number, random)
    system = healthy.system
    known = [s for s in system.states if s not in system.unknown_starts]
    if not known or set(system.states) & set(system.unknown_starts):
        return None
    record = int(random.choice(_training(healthy)))
    state = str(random.choice(known))
    own = healthy.experiments[record]
    run = Run(own.waveform, own.role, own.inputs, own.true_starts, own.signals)
    shift, step = 0.0, max(1e-3 * abs(own.true_starts[state]), 1e-4)
    for _ in range(60):
        shift = step if shift == 0.0 else 1.3 * shift
        there = {**run.starts, state: run.starts[state] + shift}
        with np.errstate(all="ignore"):
            (found,) = simulate(system, [replace(run, starts=there)])
        change = found - own.true_outputs
        sizes = np.sqrt(np.mean(change**2, axis=0)) / healthy.sigma
        if not np.isfinite(sizes).all() or sizes.max() > 6.0 * VISIBLE:
            return None
        if sizes.max() > 0.5 * VISIBLE:
            changed = _with(healthy, record, replace(own, outputs=own.outputs + change))
            name = _name(number, kind, system_name, state)
            return Case(number, name, kind, changed, record, state, shift)
    return None


def _evidence(number: int, kind: Kind, repeat: int, random: np.random.Generator) -> Case | None:
    """Peaks of one sample at an output, each where an input has one: a part that the FMU lacks."""
    system_name = PEAKED[repeat]
    healthy = _healthy(system_name, number, random)
    system = healthy.system
    changed = healthy
    for n, each in enumerate(healthy.experiments):
        inputs, outputs = each.inputs.copy(), each.outputs.copy()
        at = 20 + 50 * np.arange(7) + random.integers(0, 40, 7)
        size = 2.0 * float(np.ptp(inputs[:, 0]) or 1.0)
        inputs[at, 0] += size * random.uniform(0.6, 1.0, len(at))
        run = Run(each.waveform, each.role, inputs, each.true_starts, each.signals)
        (true,) = simulate(system, [run])
        outputs = true + each.outputs - each.true_outputs
        outputs[at, 0] += 25.0 * healthy.sigma[0] * random.uniform(0.6, 1.4, len(at))
        changed = _with(
            changed, n, replace(each, inputs=inputs, outputs=outputs, true_outputs=true)
        )
    return Case(number, _name(number, kind, system_name, system.inputs[0]), kind, changed)


def _name(number: int, kind: Kind, system: str, what: str) -> str:
    return f"{number:02d} {kind}: {system}, {what}"


_MAKERS = {
    "gain": _one_column,
    "offset": _one_column,
    "delay": _one_column,
    "sign": _one_column,
    "swapped": _swapped,
    "clock": _clock,
    "unit": _unit,
    "sentinel": _sentinel,
    "foreign": _foreign,
    "transient": _transient,
    "evidence": _evidence,
}
