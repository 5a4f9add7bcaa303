"""The cases of the benchmark: the missing effects, noise and disturbances of each.

    from closed_loop_benchmark.data import make
    from closed_loop_benchmark.scenarios import all_scenarios

    data = make(all_scenarios()[0])

A case is deterministic: its seed follows from its name. Disturbances are unmeasured and are not
functions of inputs or states.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, zip_longest
from typing import Literal

import numpy as np

from closed_loop_benchmark import waveforms
from closed_loop_benchmark.effect import (
    FILE,
    OUTSIDE,
    PAIRS,
    SINGLE,
    TEXTBOOK,
    TRIPLES,
    Effect,
    Name,
    names,
)
from closed_loop_benchmark.system import Array, Run, Split, System
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import Push

Kind = Literal[
    "single",
    "pair",
    "triple",
    "clean",
    "coloured",
    "outside",
    "textbook",
    "disturbance",
    "process noise",
    "outliers",
    "single record",
    "hidden dynamics",
    "nothing hidden",
]
SIZES = (0.05, 0.25, 1.0)
"""Sizes of effects; with the smallest size, some effects are close to the noise or below it."""


@dataclass(frozen=True)
class Noise:
    """Noise of a sensor.

    Attributes
    ----------
    share
        Standard deviation, as a share of that of the output over all training runs.
    correlation
        Correlation of consecutive samples: 0 for white noise, otherwise AR(1).
    outliers
        Share of samples with an additional error of 8 to 20 standard deviations.
    """

    share: float
    correlation: float = 0.0
    outliers: float = 0.0


WHITE = (Noise(0.01), Noise(0.02))
COLOURED = (Noise(0.01, 0.5), Noise(0.01, 0.8))


@dataclass(frozen=True)
class Scenario:
    """One case of the benchmark.

    Attributes
    ----------
    name
        Unique name.
    system
        Name of the system.
    kind
        "single" and "pair": effects that a library should have, in white noise. "coloured": one of
        those in AR(1) noise. "clean": nothing is missing, the noise white or not. "outside": an
        effect that no library has. "textbook": an effect from a book of physics, in a library or
        not. "triple": three effects. "disturbance": an unmeasured disturbance. "process noise":
        white noise on a rate, with an effect or without. "outliers": one sample in a hundred is an
        outlier, with an effect or without. "single record": one effect, in a single record. "hidden
        dynamics" and "nothing hidden": see `closed_loop_benchmark.hidden_dynamics`.
    effects
        Effects that the FMU lacks, at full size.
    accepted
        For each effect, its canonical name and the names of the same model. An effect outside the
        library has no right name; its entry is only its name here.
    size
        Factor of the effects' strengths.
    noise, seed, split
        The noise, the random generator's seed, and whether methods may be tuned on the case.
    disturbance
        The disturbance, if there is one.
    """

    name: str
    system: str
    kind: Kind
    effects: tuple[Effect, ...]
    accepted: tuple[tuple[Name, ...], ...]
    size: float
    noise: Noise
    seed: int
    split: Split
    disturbance: Disturbance | None = None


def scenario(
    system: str,
    kind: Kind,
    label: str,
    noise: Noise,
    effects: Sequence[Effect] = (),
    size: float = 1.0,
    disturbance: Disturbance | None = None,
) -> Scenario:
    """Return a case; its name, and with it its seed, follow from the arguments."""
    name = f"{system}/{kind}/{label}"
    scaled = tuple(effect.scaled(size) for effect in effects)
    accepted = tuple(names(effect, SYSTEMS[system]) for effect in scaled)
    seed, split = zlib.crc32(name.encode()), SYSTEMS[system].split
    return Scenario(name, system, kind, scaled, accepted, size, noise, seed, split, disturbance)


def one_each(
    kind: Kind,
    effects: Mapping[str, Sequence[Effect]],
    noises: tuple[Noise, Noise] = WHITE,
    sizes: Iterable[float] = SIZES,
) -> list[Scenario]:
    """Return cases with one effect each, in several sizes, alternating between kinds of noise."""
    return [
        scenario(system, kind, f"{effect.label} x{size}", noises[n % 2], [effect], size)
        for system, own in effects.items()
        for n, effect in enumerate(own)
        for size in sizes
    ]


def singles(sizes: Iterable[float] = SIZES) -> list[Scenario]:
    """Return cases with one effect in white noise, in several sizes."""
    return one_each("single", SINGLE, WHITE, sizes)


def several(kind: Kind, labels: Mapping[str, list[list[str]]], ending: str = "") -> list[Scenario]:
    """Return cases with two or three effects at once."""
    found = []
    for system, sets in labels.items():
        effects = {effect.label: effect for effect in listed(system)}
        for own in sets:
            name = f"{'+'.join(own)}{ending}"
            found.append(scenario(system, kind, name, WHITE[0], [effects[e] for e in own]))
    return found


def listed(system: str) -> tuple[Effect, ...]:
    """Return all effects of a system that have a right name or place."""
    return (*SINGLE.get(system, ()), *TEXTBOOK.get(system, ()))


def disturbed(repeats: int = 6) -> list[Scenario]:
    """Return cases with strong unmeasured disturbances: each once, and some kinds repeatedly."""
    found = [
        scenario(system, "disturbance", one.label, WHITE[0], disturbance=one)
        for system, disturbances in DISTURBANCES.items()
        for one in disturbances
    ]
    return found + [
        scenario(system, "disturbance", f"{one.label} {number}", WHITE[0], disturbance=one)
        for system, disturbances in DISTURBANCES.items()
        for one in disturbances[:1]
        for number in range(1, repeats)
    ]


def noisy(repeats: int = 2) -> list[Scenario]:
    """Return cases with unexpected noise, with every fifth effect and without any effect."""
    found = []
    for system in SYSTEMS:
        process, outlying = PROCESS_NOISE[system], Noise(0.01, outliers=0.01)
        for number in range(repeats):
            label = f"nothing {number}"
            found.append(scenario(system, "process noise", label, WHITE[0], disturbance=process))
            found.append(scenario(system, "outliers", label, outlying))
        for effect in listed(system)[::5]:
            own = [effect]
            found += [
                scenario(system, "process noise", effect.label, WHITE[0], own, disturbance=process),
                scenario(system, "outliers", effect.label, outlying, own),
            ]
    return found


def clean(repeats: int = 7) -> list[Scenario]:
    """Return cases in which nothing is missing, repeated for each system and kind of noise."""
    return [
        scenario(system, "clean", f"{noise.share} {noise.correlation} {number}", noise)
        for system in SYSTEMS
        for noise in (*WHITE, *COLOURED)
        for number in range(repeats)
    ]


def all_scenarios() -> list[Scenario]:
    """Return the complete benchmark."""
    some = {system: effects[::4] for system, effects in SINGLE.items()}
    return [
        *singles(),
        *several("pair", PAIRS, " x1.0"),
        *several("triple", TRIPLES),
        *one_each("coloured", some, COLOURED, (0.25,)),
        *one_each("outside", OUTSIDE, (WHITE[0], WHITE[0]), (1.0,)),
        *one_each("textbook", TEXTBOOK, WHITE, (0.25, 1.0)),
        *disturbed(),
        *noisy(),
        *clean(),
    ]


DRAWN: dict[Kind, int] = {"pair": 2, "triple": 3}
"""Kinds of which additional cases are drawn, and their numbers of effects."""


def drawn(kind: Kind, each: int = 12) -> list[Scenario]:
    """Return additional pairs or triples of the systems for tuning, drawn by seed.

    They are combinations of any effects of a system with a right name or place that occur in no
    other case. Two effects with a common name are one model, so such combinations are omitted.

    Parameters
    ----------
    kind
        "pair" or "triple".
    each
        Number of cases of each system.
    """
    listed_ones = PAIRS if kind == "pair" else TRIPLES
    found = []
    for name, system in SYSTEMS.items():
        if system.split != "tune":
            continue
        known = {frozenset(labels) for labels in listed_ones.get(name, ())}
        sets = [
            own
            for own in combinations(listed(name), DRAWN[kind])
            if frozenset(e.label for e in own) not in known and _told_apart(own, system)
        ]
        order = np.random.default_rng(zlib.crc32(f"{name}/{kind}".encode())).permutation(len(sets))
        for number in order[:each].tolist():
            label = f"{'+'.join(e.label for e in sets[number])} drawn"
            found.append(scenario(name, kind, label, WHITE[0], sets[number]))
    return found


def _told_apart(effects: Sequence[Effect], system: System) -> bool:
    """Return whether no two effects have a common name."""
    known = [set(names(effect, system)) for effect in effects]
    return not any(one & other for one, other in combinations(known, 2))


SHARES: dict[Kind, int] = {
    "pair": 100,
    "triple": 50,
    "single": 40,
    "coloured": 10,
    "textbook": 10,
    "outside": 10,
    "clean": 24,
    "disturbance": 18,
    "process noise": 9,
    "outliers": 9,
}
"""Number of cases of each kind for tests of parts of the search."""


def ablation_cases() -> list[Scenario]:
    """Return the cases for tests of parts of the search, all of systems for tuning.

    Any number of first cases is spread over all kinds and systems.
    """
    known = [case for case in all_scenarios() if case.split == "tune"]
    placed: list[tuple[float, Scenario]] = []
    for first, (kind, most) in enumerate(SHARES.items()):
        own = drawn(kind) if kind in DRAWN else [case for case in known if case.kind == kind]
        chosen = by_turns(own, first)[:most]
        placed += [((n + 0.5) / len(chosen), case) for n, case in enumerate(chosen)]
    return [case for _, case in sorted(placed, key=lambda each: each[0])]


def by_turns(cases: Sequence[Scenario], first: int = 0) -> list[Scenario]:
    """Return cases alternating between systems, and by seed within a system."""
    ordered, systems = sorted(cases, key=lambda case: case.seed), [*SYSTEMS]
    systems = systems[first:] + systems[:first]
    own = [[case for case in ordered if case.system == system] for system in systems]
    return [case for turn in zip_longest(*own) for case in turn if case is not None]


@dataclass(frozen=True)
class Disturbance:
    """A random disturbance of the rate of a state, different in every run.

    Attributes
    ----------
    label
        Short name, unique in a system.
    state
        The state whose rate is disturbed.
    size
        Size of the disturbance, in units of the rate.
    shape
        A few short "kicks", smooth "gusts", long intervals of "presence" and absence, or "white"
        noise, held for a sample.
    """

    label: str
    state: str
    size: float
    shape: Literal["kicks", "gusts", "presence", "white"]


DISTURBANCES = {
    system: tuple(Disturbance(label, *given) for label, given in own.items())
    for system, own in FILE["disturbances"].items()
}
PROCESS_NOISE = {
    system: Disturbance("process", state, size, "white")
    for system, (state, size) in FILE["process_noise"].items()
}
"""A random walk in a state: about two or three times the noise of the sensors, at the outputs."""


def push(
    disturbance: Disturbance, system: System, runs: Sequence[Run], random: np.random.Generator
) -> Push:
    """Draw a disturbance for every run of a system."""
    shapes = {"kicks": _kicks, "gusts": _gusts, "presence": _presence, "white": _white}
    columns = [shapes[disturbance.shape](system.times, random) for _ in runs]
    return Push(disturbance.state, disturbance.size * np.column_stack(columns))


def _kicks(time: Array, random: np.random.Generator) -> Array:
    """Return five rectangular pulses of random strength and sign."""
    found, duration = np.zeros_like(time), time[-1]
    for _ in range(5):
        start = random.uniform(0.05, 0.9) * duration
        end = start + random.uniform(0.01, 0.06) * duration
        strength = random.choice([-1.0, 1.0]) * random.uniform(0.5, 1.2)
        found += strength * ((time >= start) & (time < end))
    return found


def _gusts(time: Array, random: np.random.Generator) -> Array:
    """Return smooth noise with about fifteen oscillations in a run."""
    return waveforms.noise(time, random, 15.0 / time[-1])


def _presence(time: Array, random: np.random.Generator) -> Array:
    """Return about eight intervals of either one or zero."""
    return np.asarray(waveforms.binary(time, random, time[-1] / 8.0) > 0, dtype=float)


def _white(time: Array, random: np.random.Generator) -> Array:
    """Return independent normal values."""
    return random.normal(size=time.size)
