"""What a closed loop needs of every form of the library. A new form is picked up by being there.

The directions in which candidates move the residuals are compared with central differences of
simulations in which the effect itself acts.
"""

import re
import zlib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import (
    SYSTEMS,
    missing_effect_problem,
    opened,
    unfitted,
)

from cluster_est.closed_loop.candidates.arguments import CandidatePlace
from cluster_est.closed_loop.candidates.make import (
    EffectCandidate,
    finer_form,
    in_finer_form,
    make_candidates,
)
from cluster_est.closed_loop.fitter import FittedModel
from cluster_est.closed_loop.screening.directions import CandidatePoint, directions
from cluster_est.closed_loop.settings import LoopSettings, LoopStage
from cluster_est.closed_loop.workbench import LoopWorkbench
from workers.effects.definition import define
from workers.effects.forms import FORMS
from workers.effects.kinds import FormCoefficient
from workers.effects.site import parse_site

NAMES = (
    "mass_spring_damper", "pendulum", "cascaded_tanks", "two_mass_drive", "gantry_crane", "kiln",
    "ur5e",
)  # fmt: skip
QUICK, SLOW = ("mass_spring_damper", "ur5e"), pytest.mark.slow
LINEAR = ("mass_spring_damper", "two_mass_drive")
"""Where the response to a finite change is what a linear system says."""
KINK = re.compile(r"max|min|abs|where|sign|tanh")
WAVES_IN_A_RECORD = 5.0
VISITED = {"coulomb_table_25": ("mass_spring_damper",)}
"""Systems on which each value of a curve has more samples than the two around a switch."""


def labels_of(candidate: EffectCandidate, coefficients: Sequence[FormCoefficient]) -> list[str]:
    """Names of coefficients, one for each value: where an experiment has its own, with its name."""
    return [
        f"{c.name}[{experiment}]" if c.each else c.name
        for c in coefficients
        for experiment in (candidate.experiments if c.each else ("",))
    ]


@dataclass(frozen=True)
class SimulatedSystem:
    """A system, simulated, with all that could be missing from it."""

    bench: LoopWorkbench
    fitted: FittedModel
    trials: list[CandidatePoint]
    directions: list[np.ndarray]

    @property
    def candidates(self) -> list[EffectCandidate]:
        return [trial.candidate for trial in self.trials]

    def simulated(self, trial: CandidatePoint, amounts: list[float]) -> np.ndarray:
        """The same by simulation: central differences, or the whole change of a finite effect."""
        candidate = trial.candidate
        names = labels_of(candidate, candidate.form.coefficients)
        counts = candidate.counts(candidate.form.coefficients)
        values = [v for v, n in zip(trial.values, counts, strict=True) for _ in range(n)]
        space = self.bench.fitter.space(self.fitted.start.plus(candidate, values))
        rows = [values]
        if candidate.strengths:
            strengths = labels_of(candidate, candidate.own_strengths)
            rows = [
                [way * amount if n == strength else value
                 for n, value in zip(names, values, strict=True)]
                for strength, amount in zip(strengths, amounts, strict=True)
                for way in (1.0, -1.0)
            ]  # fmt: skip
        own = space.unknowns[self.fitted.space.size :]
        labels = [u.label.removeprefix(f"{candidate.effect.name}.") for u in own]
        points = [
            [*self.fitted.x, *(u.to_search(row[names.index(n)])
                               for u, n in zip(own, labels, strict=True))]
            for row in rows
        ]  # fmt: skip
        (seen,) = self.bench.fitter.evaluate(LoopStage.PROBE, [(space, np.array(points))])
        assert all(at.ok for at in seen), seen[0].reason
        if not candidate.strengths:
            return (seen[0].residuals - self.fitted.residuals)[:, None]
        pairs = zip(seen[::2], seen[1::2], amounts, strict=True)
        return np.column_stack([(a.residuals - b.residuals) / (2.0 * s) for a, b, s in pairs])


@pytest.fixture(scope="module")
def systems():
    found = {}
    with ExitStack() as stack:
        for name in NAMES:
            bench = stack.enter_context(opened(missing_effect_problem(name)))
            fitted = unfitted(bench)
            courses = bench.fitter.trajectories(fitted)
            rate = 2.0 * np.pi * WAVES_IN_A_RECORD / SYSTEMS[name].stop
            given = (fitted.problem, bench.fitter.description, courses, [rate], LoopSettings())
            candidates = make_candidates(*given)
            places = {
                CandidatePlace(c.site, *c.effect.variables): None
                for c in candidates
                if c.form.variables == 1
            }
            candidates += make_candidates(*given, places, beside=candidates)
            filters = {name for (_, name), f in FORMS.items() if f.is_dynamics and not f.finer_than}
            candidates += make_candidates(*given[:-1], LoopSettings(forms=tuple(filters)))
            candidates += [fine for c in candidates for fine in _finer(c)]
            trials = [CandidatePoint(c, c.grid[len(c.grid) // 2]) for c in candidates]
            known = [[fitted.estimates[n] for n in each.linear.parameter_names] for each in courses]
            moves = directions(courses, trials, [np.array(values) for values in known])
            found[name] = SimulatedSystem(bench, fitted, trials, moves)
        yield found


def _finer(candidate: EffectCandidate) -> list[EffectCandidate]:
    """A curve with more values, which a search tries only where it leads."""
    form = finer_form(candidate) if candidate.form.free else None
    if form is None:
        return []
    finer = in_finer_form(candidate, form)
    return [finer, *_finer(finer)]


@pytest.mark.parametrize(("kind", "name"), FORMS)
def test_its_direction_is_what_simulations_say(systems, kind, name):
    form = FORMS[kind, name]
    finite = not any(c.neutral == 0.0 and not c.scale for c in form.coefficients)
    able = [
        seen
        for system, seen in systems.items()
        if (system in LINEAR or not finite)
        and system in VISITED.get(name, NAMES)
        and _of(seen.candidates, kind, name)
    ]
    assert able, "it is a candidate on none of the systems: add one here that it makes sense on"
    seen = able[zlib.crc32(f"{kind} {name}".encode()) % len(able)]
    trial, direction = _visible(seen, kind, name)
    lengths = np.linalg.norm(direction, axis=0)
    assert lengths.min() > 0.0
    size = float(np.linalg.norm(seen.fitted.residuals))
    truth = seen.simulated(trial, [1e-3 * size / length for length in lengths.tolist()])
    texts = (form.equation, form.reaction, *(z.derivative for z in form.states))
    kinked = form.memory or KINK.search(" ".join(texts))
    cosines = np.sum(direction * truth, axis=0) / lengths / np.linalg.norm(truth, axis=0)
    assert cosines.min() > (0.98 if kinked else 0.999)
    near = 0.2 if form.finer_than else 0.03 if kinked else 0.01  # few samples see a narrow hat
    np.testing.assert_allclose(lengths, np.linalg.norm(truth, axis=0), rtol=near)


@pytest.mark.parametrize(
    "system", [pytest.param(name, marks=() if name in QUICK else SLOW) for name in NAMES]
)
def test_candidates_can_be_fitted(systems, system):
    """Starts lie within their bounds, the FMU takes the effect, and it has a text."""
    seen = systems[system]
    for candidate in seen.candidates:
        text = str(candidate.effect)
        assert candidate.grid, text
        for values in candidate.grid:
            assert np.isfinite(values).all(), text
            for parameter, value in zip(candidate.parameters(values), values, strict=True):
                assert parameter.lower <= value <= parameter.upper, (text, parameter)
                assert parameter.start == value, (text, parameter)
                assert parameter.scale == "linear" or parameter.lower > 0.0, (text, parameter)
        start = seen.fitted.start.plus(candidate, candidate.grid[0])
        assert start.problem.parameters[-1].name.startswith(f"{candidate.effect.name}.")
        extra = tuple(s.variable for s in seen.bench.fitter.problem.experiments[0].signals)
        define(candidate.effect, seen.bench.fitter.description, "model_exchange", extra)
        assert candidate.equation.startswith(
            (f"der({candidate.site.target}) += ", f"{candidate.site.target} -> ")
        )
        assert not re.search(r"(?<![\w.])[vw](?![\w.(])", _without(candidate)), candidate.equation
    names = [c.effect.name for c in seen.candidates]
    assert len(set(names)) == len(names)


def _without(candidate: EffectCandidate) -> str:
    """The equation without names of the FMU: no placeholder may be left in it."""
    text = candidate.equation
    for name in sorted((*candidate.effect.variables, *candidate.site.targets), key=len)[::-1]:
        text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", "", text)
    return text


def _of(candidates: list[EffectCandidate], kind: str, name: str) -> list[EffectCandidate]:
    own = [c for c in candidates if (c.site.kind, c.form.name) == (kind, name)]
    assert all(parse_site(c.effect.site, "") == c.site for c in own)
    return own


def _visible(seen: SimulatedSystem, kind: str, name: str) -> tuple[CandidatePoint, np.ndarray]:
    """Of the form's candidates the one that the outputs show best, and its direction."""
    own = _of(seen.candidates, kind, name)
    pairs = zip(seen.trials, seen.directions, strict=True)
    shown = [(trial, direction) for trial, direction in pairs if trial.candidate in own]
    return max(shown, key=lambda pair: float(np.linalg.norm(pair[1], axis=0).min()))
