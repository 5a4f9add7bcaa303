"""Experiments that begin elsewhere than the model: a spring's truth is its closed form."""

import re
from dataclasses import replace

import pytest
from support.problems.seen_springs import with_outputs
from support.problems.springs import TRUE, spring_problem

import cluster_est as ce
from cluster_est.preflight import run_checks

NOISE = 0.002
TRUTH = spring_problem(noise=NOISE)
STARTS = {f"e{e}": TRUTH.values[f"x0[e{e}]"] for e in range(5)}


def at_the_truth(**starts):
    """The springs from their true parameters; initial positions only as they are given."""
    parameters = [ce.Parameter(name, value, 0.0, 100.0) for name, value in TRUE.items()]
    if starts:
        parameters.append(ce.Parameter("x", 0.0, -1.0, 1.0, fixed=True))
    runs = tuple(
        replace(run, values=(("x", starts[run.id]),) if run.id in starts else ())
        for run in TRUTH.problem.experiments
    )
    model = replace(TRUTH.problem.model, parameters=tuple(p.target for p in parameters))
    problem = replace(TRUTH.problem, model=model, parameters=tuple(parameters), experiments=runs)
    return with_outputs(problem, lambda output: replace(output, sigma=NOISE))


def said_of(problem, fitted):
    """What a fit says of the starts, or a check before it."""
    if fitted:
        notes = ce.fit(problem).notes
    else:
        page = run_checks(problem, ce.Resources(executor="local"), 60.0)
        notes = [f"{found.found}: {found.do}" for found in page.findings]
    return [note for note in notes if "elsewhere than the model" in note]


@pytest.mark.parametrize(("fitted", "sigma"), [(False, NOISE), (True, NOISE), (True, 1.0)])
def test_a_spring_that_was_let_go_elsewhere_is_off_by_that_much(fitted, sigma):
    """A sigma of 1 is none: the noise is then that of the samples."""
    (said,) = said_of(with_outputs(at_the_truth(), lambda o: replace(o, sigma=sigma)), fitted)
    found = re.search(
        r"of 5 experiments begin .* y is up to (.*) m off, (.*) times its noise", said
    )
    distance, over_noise = map(float, found.groups())
    assert distance == pytest.approx(max(map(abs, STARTS.values())), abs=4 * NOISE)
    assert over_noise == pytest.approx(distance / NOISE, rel=0.6)
    for state in "xv":
        assert f'parameters.{state} = {{ start = 0, per = "experiment" }}' in said
    assert "values.x = NUMBER" in said


@pytest.mark.parametrize(
    ("problem", "fitted"),
    [
        (at_the_truth(**STARTS), False),
        (at_the_truth(**STARTS), True),
        (TRUTH.problem, True),
        (at_the_truth(**STARTS | {"e0": STARTS["e0"] + 0.3}), True),
        (with_outputs(at_the_truth(**STARTS), lambda o: replace(o, values=o.values + 0.3)), True),
    ],
    ids=["right", "right, fitted", "estimated", "one of five", "an offset that stays"],
)
def test_where_the_starts_are_right_nothing_is_said(problem, fitted):
    assert said_of(problem, fitted) == []
