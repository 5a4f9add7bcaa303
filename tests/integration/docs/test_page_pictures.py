import re
from xml.etree import ElementTree

import numpy as np
import pytest
from docs.cost_picture import NAMED, TIMES, cost_curve, limits
from docs.form_pictures import FACTORS, evaluated
from docs.form_pictures import picture as picture_of_forms
from docs.page_pictures import DOCS, PICTURES
from docs.step_picture import LARGE, SMALL, TRUE, experiment, held, reference
from scipy.signal import lsim

from cluster_est.executors.backlog import BATCH_SECONDS
from cluster_est.problem.costs import COSTS
from workers.effects.forms import FORMS
from workers.residuals.comparison import SimulatedOutputs
from workers.residuals.experiment_residuals import SignalBounds

POINT = re.compile(r"-?\d+\.\d+")
PAGES = {
    "costs_and_limits": "costs_and_constraints.md",
    "cluster_layout": "on_a_cluster.md",
    "held_input": "exported_fmus.md",
    "multiple_shooting": "multiple_shooting.md",
    "process_noise": "process_noise.md",
}
AT_SIX = {
    "sse": 36.0,
    "sae": 6.0,
    "huber": 2.0 * 6.0 - 1.0,
    "soft_l1": 2.0 * (np.sqrt(37.0) - 1.0),
    "cauchy": np.log(37.0),
}
"""The cost of a residual of 6 sigma, with a scale of 1."""
SLOW = ("multiple_shooting", "process_noise")
DRAWN = PICTURES | {"form_shapes": picture_of_forms}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in DRAWN]
)
def test_the_picture_is_that_of_the_library_today(name):
    shown, drawn = (DOCS / f"{name}.svg").read_text(encoding="utf-8"), DRAWN[name]()
    assert POINT.sub("#", shown) == POINT.sub("#", drawn)
    numbers = [[float(n) for n in POINT.findall(each)] for each in (shown, drawn)]
    assert numbers[0] == pytest.approx(numbers[1], abs=0.2)


@pytest.mark.parametrize("name", PAGES)
def test_the_page_shows_the_picture_and_says_what_is_in_it(name):
    page = (DOCS / PAGES[name]).read_text(encoding="utf-8")
    (said,) = re.findall(rf"!\[(.+)\]\({name}\.svg\)", page)
    assert len(said) > 50
    text = (DOCS / f"{name}.svg").read_text(encoding="utf-8")
    assert len(text) < 60_000
    assert "prefers-color-scheme: dark" in text
    assert ElementTree.fromstring(text)[0].text


def test_the_picture_of_a_cluster_says_how_long_a_batch_takes():
    text = (DOCS / "cluster_layout.svg").read_text(encoding="utf-8")
    assert f"{BATCH_SECONDS:g} s, two for each actor" in text


def test_a_cost_is_drawn_as_it_is():
    drawn = set(COSTS) - {"likelihood", "total"}  # those are of many residuals
    assert set(NAMED) == drawn, "a line of NAMED for each, then scripts/docs/page_pictures.py"
    for name, value in AT_SIX.items():
        residuals, costs = cost_curve(name)
        ends = residuals[[0, -1]], costs[[0, -1]]
        assert np.concatenate(ends) == pytest.approx([-6.0, 6.0, value, value])


def test_an_equation_of_a_form_is_drawn_as_it_stands():
    """A factor of a parameter of 1 that falls to 0.1 far from the middle."""
    v = np.array([-1.0, 0.0, 0.3])
    found = evaluated(FORMS["parameter", "hill"], FACTORS["hill"], (v, np.ones(3), v, v))
    assert found == pytest.approx([1.0 - 0.9 / 1.09, 1.0, 0.55])


@pytest.mark.parametrize("limit", limits(), ids=lambda limit: limit.key)
def test_the_violation_in_the_picture_is_what_a_worker_finds(limit):
    bound = limit.bound
    signal = np.interp(bound.times, TIMES, limit.simulated)[None, :, None]
    simulated = SimulatedOutputs(bound.times, (bound.variable,), signal, np.zeros((1, 0)))
    found = SignalBounds((bound,)).compare(simulated).values.max()
    _, allowed, reached = limit.worst
    assert found * bound.scale == pytest.approx(abs(reached - allowed))
    assert abs(reached - allowed) > 0.02  # to be seen


def test_the_mass_is_moved_by_a_force_that_a_tool_holds_and_by_one_without_stairs():
    (force,), system = experiment().inputs, ([1.0], [TRUE["m"], TRUE["c"], TRUE["k"]])
    exact = lsim(system, force.values, force.times)[1]
    assert reference().values == pytest.approx(exact, abs=1e-6)
    for found in map(held, (LARGE, SMALL)):
        exact = lsim(system, found.force, found.times, interp=False)[1]
        assert found.position == pytest.approx(exact, abs=1e-6)


def test_the_page_says_how_large_the_difference_is():
    (measured,) = experiment().outputs
    noise = np.std(measured.values - reference().values)
    page = (DOCS / "exported_fmus.md").read_text(encoding="utf-8")
    assert f"the difference is {1e3 * held(SMALL).rms:.1f} mm" in page
    assert f"The noise of the measured position is {1e3 * noise:.1f} mm" in page
    assert "five times as large" in page
    assert held(LARGE).rms / held(SMALL).rms == pytest.approx(5.0, rel=0.05)
