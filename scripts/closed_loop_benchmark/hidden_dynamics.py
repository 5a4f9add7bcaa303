"""Cases of hidden dynamics: stores, delays, modes, laws of two arguments, forms at outputs.

    from closed_loop_benchmark.hidden_dynamics import hidden_cases, hidden_problem

    problem, data = hidden_problem(hidden_cases()[0])

Sixty cases have one effect. Three hundred have nothing to find: clean ones, ones in coloured noise,
and ones with an unmeasured disturbance. Their systems occur in no other kind. Half of the cases are
open: every other case of each class by its seed, starting with the first. The others are held back,
and no threshold may be tuned on them.
"""

from __future__ import annotations

import tomllib
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from closed_loop_benchmark import figures as f
from closed_loop_benchmark.data import Data, Experiment, draw_noise, make_problem
from closed_loop_benchmark.effect import Effect, Name
from closed_loop_benchmark.hidden_systems import HIDDEN_SYSTEMS, PUSHES, archive
from closed_loop_benchmark.hidden_truth import NOTHING, Hidden, follow
from closed_loop_benchmark.scenarios import COLOURED, Disturbance, Kind, Noise, Scenario, push
from closed_loop_benchmark.scoring import Score
from closed_loop_benchmark.system import Split
from closed_loop_benchmark.tables import markdown
from cluster_est import Problem

FILE = tomllib.loads(Path(__file__).with_name("hidden_dynamics.toml").read_text(encoding="utf-8"))
FORMS: dict[str, list[str]] = FILE["forms"]
CLASSES: dict[str, list[str]] = FILE["classes"]
NOISES = tuple(Noise(share) for share in (0.005, 0.01, 0.02, 0.03))
SHAPES: tuple[Literal["kicks", "gusts", "presence"], ...] = ("kicks", "gusts", "presence")
EACH = 100
"""Number of cases that are clean, in coloured noise and disturbed."""
HIDDEN: Kind = "hidden dynamics"
WITHOUT: Kind = "nothing hidden"
KINDS = (HIDDEN, WITHOUT)


def _read() -> Iterable[tuple[Scenario, Hidden]]:
    for system, own in FILE["case"].items():
        for label, given in own.items():
            form = label.split(":")[0]
            effect = _effect(label, given, FORMS[form][0])
            names = _names(given["places"], [*dict.fromkeys((effect.form, *FORMS[form]))])
            case = _scenario(system, HIDDEN, f"{class_of(form)}/{label}", Noise(given["noise"]))
            yield replace(case, effects=(effect,), accepted=(names,)), _hidden(given)


def class_of(form: str) -> str:
    """Return the class of a kind of effect."""
    return next(name for name, members in CLASSES.items() if form in members)


def _effect(label: str, given: Mapping[str, Any], form: str) -> Effect:
    site, _, variables = given["places"][0].partition(" | ")
    numbers = given.get("numbers", {})
    variable, _, second = variables.partition("*")
    form = given.get("form", form)
    values = tuple(numbers.values())
    return Effect(label, form, site, values, variable, second, constants=tuple(numbers.items()))


def _names(places: Sequence[str], forms: Sequence[str]) -> tuple[Name, ...]:
    """Return every form at every place."""
    parts = [place.partition(" | ") for place in places]
    return tuple(Name(form, site, variable) for site, _, variable in parts for form in forms)


def _hidden(given: Mapping[str, Any]) -> Hidden:
    numbers = {**given.get("numbers", {}), **given.get("also", {})}
    sections = ("states", "late", "rates", "inputs", "parameters", "outputs")
    return Hidden(numbers, **{section: given.get(section, {}) for section in sections})


def _scenario(
    system: str, kind: Kind, label: str, noise: Noise, disturbance: Disturbance | None = None
) -> Scenario:
    name = f"{system}/{kind}/{label}"
    seed = zlib.crc32(name.encode())
    return Scenario(name, system, kind, (), (), 1.0, noise, seed, "tune", disturbance)


def _divided(cases: Sequence[Scenario]) -> list[Scenario]:
    """Hold back every other case of each class, by seed."""
    places: dict[str, int] = {}
    splits: dict[str, Split] = {}
    for case in sorted(cases, key=lambda case: case.seed):
        own = case.name.split("/")[2]
        splits[case.name] = "report" if places.get(own, 0) % 2 else "tune"
        places[own] = places.get(own, 0) + 1
    return [replace(case, split=splits[case.name]) for case in cases]


READ = tuple(_read())
TRUTHS = {case.name: hidden for case, hidden in READ}
"""The hidden dynamics of each case, by name."""


def cases_of(kind: Kind) -> list[Scenario]:
    """Return the cases of one of the two kinds."""
    return hidden_cases() if kind == HIDDEN else cases_with_nothing_hidden()


def hidden_cases() -> list[Scenario]:
    """Return the sixty cases with an effect."""
    return _divided([case for case, _ in READ])


def cases_with_nothing_hidden() -> list[Scenario]:
    """Return the cases with nothing to find, alternating between systems."""
    systems, cases = [*HIDDEN_SYSTEMS], []
    for number in range(EACH):
        system = systems[number % len(systems)]
        state, size = PUSHES[system]
        shape = SHAPES[number // len(systems) % len(SHAPES)]
        disturbance = Disturbance(shape, state, size, shape)
        for label, noise, pushed in (
            ("clean", NOISES[number % len(NOISES)], None),
            ("coloured", COLOURED[number % len(COLOURED)], None),
            ("disturbed", NOISES[1], disturbance),
        ):
            cases.append(_scenario(system, WITHOUT, f"{label}/{number}", noise, pushed))
    return _divided(cases)


def hidden_problem(case: Scenario) -> tuple[Problem, Data]:
    """Return the problem that a method is given, and its data."""
    data = hidden_data(case)
    return make_problem(data, archive(case.system)), data


def hidden_data(case: Scenario, samples: int | None = None, share: float = 1.0) -> Data:
    """Simulate a case and add its noise.

    Parameters
    ----------
    case
        A case of one of the two kinds.
    samples
        Number of samples; all by default.
    share
        Share of the effect that acts.

    Returns
    -------
    Data
        The same for the same arguments.
    """
    whole = HIDDEN_SYSTEMS[case.system]
    system = replace(whole, samples=samples or whole.samples)
    excited, pushed, measured, guessed = np.random.default_rng(case.seed).spawn(4)
    runs = [
        replace(run, inputs=run.inputs[: system.samples])
        for run in system.excitation(whole.times, excited)
    ]
    pushing = None
    if case.disturbance is not None:
        drawn = push(case.disturbance, system, runs, pushed)
        pushing = (drawn.state, drawn.signal)
    hidden = TRUTHS.get(case.name, NOTHING)
    true = follow(system, runs, hidden, share=share, push=pushing, seed=case.seed)
    training = [y for run, y in zip(runs, true, strict=True) if run.role == "train"]
    sigma = case.noise.share * np.concatenate(training).std(axis=0)
    experiments = tuple(
        Experiment(
            run.waveform,
            run.role,
            run.inputs,
            np.zeros((system.samples, 0)),
            y + sigma * draw_noise(y.shape, case.noise, measured),
            run.starts,
            y,
            run.starts,
        )
        for run, y in zip(runs, true, strict=True)
    )
    starts = {
        name: value * (1.0 + system.spread(name) * guessed.uniform(-1.0, 1.0))
        for name, value in system.parameters.items()
    }
    times = system.times
    return Data(case, system, times, times, experiments, sigma, starts, dict(system.parameters))


def hidden_table(scores: Sequence[Score]) -> str:
    """Return a table of the cases that are right in place, in kind and in numbers, by class."""
    rows = []
    for kind in KINDS:
        own = f.kinds(scores, kind)
        for name in dict.fromkeys(score.name.split("/")[2] for score in own):
            members = [score for score in own if score.name.split("/")[2] == name]
            rows.append(_row(name, members))
    head = ["", "cases", "found", "any effect", "place", "kind", "intervals", "worse held out"]
    return markdown([*head, "held-out error: declared, found, truth"], rows)


def _row(name: str, scores: Sequence[Score]) -> list[str]:
    there = [score for score in scores if score.true]
    held, count = sum(s.covered for s in scores), sum(s.intervals for s in scores)
    errors = [f.median(getattr(s, key) for s in scores) for key in ("before", "after", "floor")]
    return [
        name,
        str(len(scores)),
        f.share(scores, f.found),
        f.share(scores, f.changed),
        f.share(there, lambda s: f.place(s) or s.numerical),
        f.share(there, f.right),
        f"{held}/{count}",
        f.share(scores, f.worse),
        ", ".join(errors),
    ]
