"""Unknowns of held-out experiments are fitted with the shared unknowns of the others."""

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
    """y = slope t + start, with one start for each experiment."""

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        self.problem = problem

    def _answer(self, task):
        (output,) = self.problem.experiments[task.experiment].outputs
        slope, start = task.values
        rest = (slope * output.times + start - output.values) / output.sigmas
        return answer_with(task, rest, [len(rest)])


def lines(generator: np.random.Generator, scale: str = "linear") -> Problem:
    runs = []
    for e, times in enumerate(TIMES):
        values = SLOPE * times + 0.5 * e + NOISE * generator.normal(size=len(times))
        outputs = (Output("y", times, values, sigma=NOISE),)
        role = "test" if e == 2 else "train"
        runs.append(Experiment(f"e{e}", 0.0, 10.0, (), outputs, role=role))
    slope = Parameter("slope", 1.0, (0.1, 10.0), scale=scale)
    parameters = (slope, Parameter("start", 0.0, per="experiment"))
    model = Model("none", b"", "model_exchange", Solver("rk4"), ("slope", "start"))
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


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_the_error_of_the_slope_is_part_of_the_interval(scale):
    """By hand: the start's variance is s^2 / n + mean(t)^2 var(slope)."""
    _, interval, given_the_slope = held_out(lines(np.random.default_rng(1), scale))
    spread = sum(float(np.sum((t - t.mean()) ** 2)) for t in TIMES[:2])
    expected = NOISE * np.sqrt(1.0 / 400 + TIMES[2].mean() ** 2 / spread)
    assert interval.std_error == pytest.approx(expected, rel=0.15)
    assert given_the_slope.std_error < 0.2 * expected


def test_it_holds_the_truth_as_often_as_it_says():
    generator, held, without = np.random.default_rng(2), 0, 0
    for _ in range(200):
        _, interval, alone = held_out(lines(generator))
        held += interval.lower95 <= 1.0 <= interval.upper95
        without += alone.lower95 <= 1.0 <= alone.upper95
    assert 180 <= held <= 199  # 95 %, within three standard errors
    assert without < 80
