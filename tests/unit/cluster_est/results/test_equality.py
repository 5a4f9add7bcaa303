import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import spring_problem

import cluster_est as ce
from cluster_est.methods.method import Points
from workers.messages import Curve, Outcome, Status, Trajectory
from workers.messages.types import same_content

TIMES = np.arange(5.0)
PROBLEM = spring_problem(experiments=2, samples=20).problem
RUN = PROBLEM.experiments[0]
RESIDUALS = np.array([0.0, 1.0, np.nan])
TRAJECTORY = Trajectory(("y",), TIMES, np.arange(5.0)[:, None])
KINDS = {
    "problem": PROBLEM,
    "experiment": RUN,
    "input": RUN.inputs[0],
    "output": RUN.outputs[0],
    "curve": Curve(("x",), TIMES[:, None], TIMES, (0.0,)),
    "outcome": Outcome(0, Status.OK, residuals=RESIDUALS, trajectory=TRAJECTORY, seconds=np.nan),
    "points": Points(np.array([[1.0, -0.0]]), "trial"),
    "table": ce.Experiment.from_table({"t": TIMES, "y": TIMES}, id="a", time="t", outputs=["y"]),
}


@pytest.fixture(scope="module")
def result():
    return ce.fit(PROBLEM, ce.LeastSquares(max_iterations=1))


def copies(one):
    return copy.deepcopy(one), pickle.loads(pickle.dumps(one))


@pytest.mark.parametrize("name", KINDS)
def test_a_copy_is_equal(name):
    for other in copies(KINDS[name]):
        assert other is not KINDS[name]
        assert other == KINDS[name]
    assert KINDS[name] != name


def test_a_copy_of_a_result_is_equal_and_another_result_is_not(result):
    assert "m" in result.params  # a result is also copied after it has been read
    for other in copies(result):
        assert other == result
        assert list(other.params.items()) == list(result.params.items())
    assert replace(result, seed=result.seed + 1) != result
    x = np.nextafter(result.solution.x, np.inf)
    assert replace(result, solution=replace(result.solution, x=x)) != result


def test_one_changed_bit_is_a_difference():
    output = RUN.outputs[0]
    values = output.values.copy()
    values[3] = np.nextafter(values[3], np.inf)
    changed = replace(output, values=values)
    assert changed != output
    run = replace(RUN, outputs=(changed,))
    assert run != RUN
    assert replace(PROBLEM, experiments=(run, *PROBLEM.experiments[1:])) != PROBLEM
    assert replace(output, sigma=2.0 * output.sigma) != output


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (np.array([0.0]), np.array([-0.0]), False),
        (np.array([np.nan, 1.0]), np.array([-np.nan, 1.0]), True),
        (np.array([np.nan, 1.0]), np.array([1.0, np.nan]), False),
        (np.zeros((2, 3)), np.zeros((3, 2)), False),
        (np.zeros(2), np.zeros(2, np.float32), False),
        (np.zeros((4, 2))[::2], np.zeros((2, 2)), True),
        (np.array([1.0, np.nan], object), np.array([1.0, np.nan], object), True),
        (float("nan"), float("nan"), True),
        ({"a": TIMES}, {"a": TIMES.copy()}, True),
        ({"a": TIMES}, {"b": TIMES}, False),
        ([TIMES], (TIMES,), False),
        ((1.0, 2.0), (1.0,), False),
    ],
)
def test_arrays_are_compared_bit_for_bit_but_for_nan(one, other, same):
    assert same_content(one, other) is same
    assert same_content(other, one) is same


def test_hashes_stay_as_they_are():
    with pytest.raises(TypeError, match="unhashable"):
        hash(RUN.inputs[0])
    assert hash(PROBLEM.parameters[0]) == hash(copy.deepcopy(PROBLEM.parameters[0]))
