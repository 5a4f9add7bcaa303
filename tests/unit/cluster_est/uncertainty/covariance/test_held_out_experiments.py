"""Unknowns of held-out experiments are fitted with the shared unknowns of the others."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems.answering import AnsweringExecutor, answer_with

from cluster_est import Experiment, LeastSquares, Model, Output, Parameter, Problem, Solver
from cluster_est.problem.search_space import make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import assess, assess_held_out

NOISE = 0.1
SLOPE = 2.0
TIMES = [np.linspace(0.0, 1.0, 40), np.linspace(0.0, 1.5, 40), np.linspace(4.0, 6.0, 400)]
"""The held-out experiment is long and far from zero, so its start depends on the slope."""


class Lines(AnsweringExecutor):
    """y = slope t + start + tilt t + twist t, with one start and tilt for each experiment.

    The training experiments show slope + twist, the held-out one slope - twist.
    """

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        self.problem = problem

    def _answer(self, task):
        (output,) = self.problem.experiments[task.experiment].outputs
        slope, start, tilt, twist = (*task.values, *(0.0,) * (4 - len(task.values)))
        side = -1.0 if task.experiment == 2 else 1.0
        line = (slope + tilt + side * twist) * output.times + start
        rest = (line - output.values) / output.sigmas
        return answer_with(task, rest, [len(rest)])


SLOPES = Parameter("slope", 1.0, (0.1, 10.0))


def lines(generator: np.random.Generator, slope: Parameter = SLOPES, *more: Parameter) -> Problem:
    runs = []
    for e, times in enumerate(TIMES):
        values = SLOPE * times + 0.5 * e + NOISE * generator.normal(size=len(times))
        outputs = (Output("y", times, values, sigma=NOISE),)
        role = "test" if e == 2 else "train"
        runs.append(Experiment(f"e{e}", 0.0, 10.0, (), outputs, role=role))
    parameters = (slope, Parameter("start", 0.0, per="experiment"), *more)
    names = tuple(p.name for p in parameters)
    model = Model("none", b"", "model_exchange", Solver("rk4"), names)
    return Problem(model, parameters, tuple(runs))


def held_out(problem: Problem):
    """The start of the held-out experiment, its interval, and the interval without the slope's."""
    with Lines(problem) as executor:
        runner, method = Runner(executor), LeastSquares(differences="central")
        train = make_space(problem, (0, 1))
        (solved,) = runner.run([SearchRequest("train", method, train)])
        test = make_space(problem, (2,), train.estimates(solved.x))
        (own,) = runner.run([SearchRequest("test", method, test)])
        found = assess_held_out(runner, (test, own), (train, solved, assess(train, solved)))
        return own.x[0], found.intervals[0], assess(test, own).intervals[0]


SPREAD = sum(float(np.sum((t - t.mean()) ** 2)) for t in TIMES[:2])
EXPECTED = NOISE * np.sqrt(1.0 / 400 + TIMES[2].mean() ** 2 / SPREAD)
"""By hand: the start's variance is s^2 / n + mean(t)^2 var(slope)."""


@pytest.mark.parametrize(
    "slope",
    [SLOPES, replace(SLOPES, scale="log"), replace(SLOPES, scale="log", bounds=(0.1, 2.2))],
    ids=["linear", "log", "near a bound"],
)
def test_the_error_of_the_slope_is_part_of_the_interval(slope):
    _, interval, given_the_slope = held_out(lines(np.random.default_rng(1), slope))
    assert interval.std_error == pytest.approx(EXPECTED, rel=0.15)
    assert interval.upper95 - interval.lower95 == pytest.approx(4.0 * EXPECTED, rel=0.2)
    assert given_the_slope.std_error < 0.2 * EXPECTED


def test_an_unknown_at_its_bound_takes_none_of_the_error():
    """The held-out experiment has a tilt of its own, which is 0 in truth and must be larger."""
    tilt = Parameter("tilt", 0.7, (0.1, 1.0), per="experiment")
    problem = lines(np.random.default_rng(1), SLOPES, tilt)
    runs = [replace(e, values=(("tilt", 0.0),)) if e.id != "e2" else e for e in problem.experiments]
    problem = replace(problem, experiments=tuple(runs))
    _, interval, alone = held_out(problem)
    of_the_slope = TIMES[2].mean() * NOISE / np.sqrt(SPREAD)
    assert interval.std_error == pytest.approx(np.hypot(alone.std_error, of_the_slope), rel=0.2)
    assert interval.std_error > 1.05 * alone.std_error


def test_there_is_no_interval_if_a_shared_unknown_has_none():
    """The training experiments determine slope + twist only."""
    twist = Parameter("twist", 0.0, (-5.0, 5.0))
    tilt = Parameter("tilt", 0.0, fixed=True)
    _, interval, alone = held_out(lines(np.random.default_rng(1), SLOPES, tilt, twist))
    assert np.isnan(interval.std_error)
    assert np.isnan(interval.lower95)
    assert np.isfinite(alone.std_error)


def test_it_holds_the_truth_as_often_as_it_says():
    generator, held, without = np.random.default_rng(2), 0, 0
    for _ in range(200):
        _, interval, alone = held_out(lines(generator))
        held += interval.lower95 <= 1.0 <= interval.upper95
        without += alone.lower95 <= 1.0 <= alone.upper95
    assert 180 <= held <= 199  # 95 %, within three standard errors
    assert without < 80
