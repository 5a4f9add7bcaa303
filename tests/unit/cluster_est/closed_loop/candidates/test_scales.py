"""What the data say about where the coefficients of a candidate could lie: sines, worked out."""

from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est import LoopSettings, Solver
from cluster_est.closed_loop.candidates.make import make_candidates
from workers.effects.forms import FORMS
from workers.effects.site import parse_site

PROBLEM = missing_effect_problem("mass_spring_damper", signals=())
RATE = 2.0 * np.pi
"""Of six turns in a record, of 6 s with 0.01 s between two samples."""
SIZE = 3.0
RMS = SIZE / np.sqrt(2.0)


@pytest.fixture(scope="module")
def spring():
    with opened(PROBLEM) as bench:
        return bench.description, bench.trajectories(unfitted(bench))


@pytest.fixture
def candidates(spring):
    """Those of a spring whose signals are given, as functions of time."""

    def made(problem=PROBLEM, **signals):
        description, runs = spring
        given = [
            replace(
                run,
                signals=dict(run.signals)
                | {n: np.broadcast_to(f(run.times), len(run.times)) for n, f in signals.items()},
            )
            for run in runs
        ]
        found = make_candidates(problem, description, given, (2.5, 7.0), LoopSettings())
        return {(str(c.site), c.form.name, *c.effect.variables): c for c in found}

    return made


def sine(t):
    return SIZE * np.sin(RATE * t)


def axis(candidate, name):
    """The values of a coefficient that are looked at, ascending."""
    place = [c.name for c in candidate.form.coefficients].index(name)
    return sorted({values[place] for values in candidate.grid})


V = ("der(v)", "v")
SCALES = [
    (*V, "coulomb", "width", lambda g: g * RMS),
    (*V, "gap", "at", lambda g: g * SIZE),
    (*V, "hinge", "at", lambda g: SIZE * np.sin(np.pi * (g - 0.5))),
    (*V, "dahl", "x0", lambda g: g * RMS / RATE),
    (*V, "table", "low", lambda g: -SIZE * np.cos(0.01 * np.pi)),
    (*V, "table", "high", lambda g: SIZE * np.cos(0.01 * np.pi)),
    ("der(v)", "x", "periodic", "n", lambda g: 2.0 * np.pi * g / 0.2),
    ("parameter k", "v", "linear", "at", lambda g: 0.0),
    ("parameter k", "v", "magnitude", "at", lambda g: 2.0 * SIZE / np.pi),
    ("parameter k", "v", "square", "at", lambda g: RMS**2),
    ("parameter k", "", "drift", "at", lambda g: 3.0),
    ("output y", "", "lag", "tau", lambda g: g * 0.01),
    ("output y", "", "mode", "f", lambda g: g / 0.01),
    ("output y", "", "saturation", "limit", lambda g: g * (SIZE + 1.0)),
    ("output y", "", "clip_above", "limit", lambda g: 1.0 - SIZE + g * 2.0 * SIZE),
    ("input F", "", "rate_limit", "rate", lambda g: g * SIZE * RATE),
]


@pytest.mark.parametrize(("site", "variable", "form", "coefficient", "expected"), SCALES)
def test_a_grid_is_in_proportion_to_the_signals(
    candidates, site, variable, form, coefficient, expected
):
    found = candidates(v=sine, F=sine, y=lambda t: sine(t) + 1.0, x=lambda t: 0.1 * np.sin(9.0 * t))
    shares = {c.name: c.grid for c in FORMS[parse_site(site, "").kind, form].coefficients}
    key = (site, form, variable) if variable else (site, form)
    truth = sorted({expected(g) for g in shares[coefficient] or (1.0,)})
    assert axis(found[key], coefficient) == pytest.approx(truth, rel=1e-2, abs=2e-2)


def test_waves_begin_at_the_peaks_of_a_spectrum(candidates):
    assert axis(candidates()["der(v)", "sine"], "f") == [2.5, 7.0]


@pytest.mark.parametrize(("span", "whole"), [(1.0, []), (200.0, list(range(1, 16)))])
def test_waves_of_an_angle_of_many_turns_are_whole_numbers_too(candidates, span, whole):
    found = axis(candidates(x=lambda t: span * t / t[-1])["der(v)", "periodic", "x"], "n")
    repeats = 2.0 * np.pi * np.arange(3, 33) / 2.0 / span
    assert found == pytest.approx(sorted([*repeats, *(n for n in whole if n > repeats[-1])]))


@pytest.mark.parametrize(("solver", "moved"), [("rk4", 1.0), ("dormand_prince", 0.0)])
def test_a_switch_is_no_narrower_than_what_a_fixed_step_goes_across(candidates, solver, moved):
    """|v'| = 3 RATE |cos| has the median 3 RATE / sqrt(2); a step is one from sample to sample."""
    problem = replace(PROBLEM, model=replace(PROBLEM.model, solver=Solver(solver)))
    found = axis(candidates(problem, v=sine)["der(v)", "coulomb", "v"], "width")
    crossed = moved * 0.01 * SIZE * RATE / np.sqrt(2.0)
    shares = FORMS["derivative", "coulomb"].coefficients[-1].grid
    assert found == pytest.approx(sorted({max(g * RMS, crossed) for g in shares}), rel=1e-2)


@pytest.mark.parametrize(
    ("form", "signal", "expected"),
    [
        ("linear", sine, True),
        ("linear", lambda t: 5.0, False),
        ("linear", lambda t: 0.0, False),
        ("coulomb", sine, True),
        ("coulomb", lambda t: sine(t) + 2.9, False),
        ("coulomb", lambda t: np.abs(sine(t)), False),
        ("square_root", lambda t: sine(t) + 4.0, True),
        ("square_root", lambda t: 1e-9 * (sine(t) + 2.0), False),
        ("square_root", lambda t: 1e-9 * (sine(t) + 3.0), True),
        ("table", sine, True),
        ("table", lambda t: np.where(t > 5.97, 1.0, 0.0), False),
    ],
)
def test_forms_that_make_sense_for_a_signal(candidates, form, signal, expected):
    assert (("der(v)", form, "v") in candidates(v=signal)) is expected


def test_a_product_needs_two_signals_that_move(candidates):
    assert not any("product" in key and "F" in key for key in candidates(F=lambda t: 2.0))


def test_an_experiment_without_a_signal_does_not_count():
    problem = missing_effect_problem("two_mass_drive", signals=())
    first, second = problem.experiments
    second = replace(second, outputs=second.outputs[:1])
    with opened(replace(problem, experiments=(first, second))) as bench:
        runs = bench.trajectories(unfitted(bench))
        settings = LoopSettings(forms=("saturation",), sites=("output load_speed",))
        (found,) = make_candidates(bench.problem, bench.description, runs, (), settings)
    largest = np.abs(runs[0].signal("load_speed")).max()
    assert axis(found, "limit")[-1] == pytest.approx(0.95 * largest)
