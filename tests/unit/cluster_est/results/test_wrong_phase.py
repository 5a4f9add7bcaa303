import re

import numpy as np
import pytest
from support.problems.springs import FMU
from support.truth.exact_linear import position

from cluster_est import Experiment, Input, Model, Output, Parameter, Problem, Resources, Solver
from cluster_est.results.wrong_phase import swing_of, wrong_phase_notes
from cluster_est.studies.fit import simulate

TIMES = np.linspace(0.0, 30.0, 601)
MASS, STIFFNESS, DAMPING = 1.2, 30.0, 0.05
PERIOD = 2.0 * np.pi / np.sqrt(STIFFNESS / MASS)


def swinging(force=0.0, offset=0.0) -> Problem:
    """A mass that swings freely, or is driven by a sine at its own frequency."""
    given = force * np.sin(2.0 * np.pi * TIMES / PERIOD)
    measured = position(TIMES, given, m=MASS, k=STIFFNESS, c=DAMPING, x0=0.1, v0=0.0) + offset
    parameters = (
        Parameter("k", STIFFNESS, bounds=(1.0, 500.0)),
        Parameter("c", DAMPING, bounds=(0.0, 100.0)),
        Parameter("m", MASS, bounds=(0.1, 10.0)),
        Parameter("x", 0.1, bounds=(-1.0, 1.0)),
    )
    names = tuple(each.target for each in parameters)
    solver = Solver("dormand_prince", rtol=1e-8)
    model = Model(FMU.name, FMU.read_bytes(), "model_exchange", solver, names)
    record = Experiment(
        "free", 0.0, 30.0, (Input("F", TIMES, given),), (Output("y", TIMES, measured),)
    )
    return Problem(model, parameters, (record,))


def notes(problem, **values):
    return wrong_phase_notes(problem, [*simulate(problem, Resources(), values).values()], 1)


@pytest.mark.parametrize(
    ("values", "how"),
    [
        ({"k": 12.0}, "oscillates every"),
        ({"k": 60.0}, "oscillates every"),
        ({"c": 10.0}, "hardly moves"),
    ],
)
def test_a_model_that_swings_otherwise_is_named_with_what_to_try(values, how):
    (said,) = notes(swinging(), **values)
    period, length = (float(each) for each in re.findall(r"(?:period of|length =) (\S+)", said))
    assert (period, length) == pytest.approx((PERIOD, 2.0 * PERIOD), rel=0.02)
    assert said.startswith("in free, y oscillates")
    assert ", 24 times in the record," in said
    assert f"the fitted model {how}" in said
    assert "multistart.n = 20" in said


def test_more_starts_are_proposed_where_there_were_many():
    problem = swinging()
    simulations = [*simulate(problem, Resources(), {"k": 12.0}).values()]
    (said,) = wrong_phase_notes(problem, simulations, 20)
    assert "multistart.n = 100" in said


@pytest.mark.parametrize(
    ("problem", "values"),
    [
        (swinging(), {}),
        (swinging(), {"c": 0.08}),
        (swinging(offset=1.0), {}),  # another fault, which no start removes
        (swinging(force=3.0), {"k": 60.0}),  # its period is that of the input
    ],
    ids=["right", "nearly right", "offset", "driven"],
)
def test_nothing_is_said_of_another_fault(problem, values):
    assert notes(problem, **values) == ()


@pytest.mark.parametrize("cycles", [3.0, 10.0, 33.3])
@pytest.mark.parametrize("decay", [0.0, 2.0])
def test_the_cycles_of_a_swing_are_counted(cycles, decay):
    times = np.sort(np.random.default_rng(1).uniform(0.0, 5.0, 900))
    wave = np.exp(-decay * times / 5.0) * np.sin(2.0 * np.pi * cycles * times / 5.0)
    found = swing_of(times, 3.0 + 2.0 * times + wave)
    assert found is not None
    assert found.cycles == pytest.approx(cycles, abs=0.5)
    assert found.period == pytest.approx(5.0 / found.cycles, rel=0.01)


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(500),
        np.linspace(0.0, 1.0, 500),
        np.random.default_rng(2).normal(size=500),
        np.exp(-np.linspace(0.0, 5.0, 500)),
        np.sin(np.linspace(0.0, 6.0, 500)),
        np.full(500, np.nan),
    ],
    ids=["still", "ramp", "noise", "decay", "one cycle", "failed"],
)
def test_what_does_not_swing_has_none(values):
    assert swing_of(np.linspace(0.0, 1.0, 500), values) is None
