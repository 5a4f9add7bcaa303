"""Steps along directions stay within bounds."""

from __future__ import annotations

import numpy as np
import pytest
from support.loop_objects import made_problem

from cluster_est import Parameter, Problem
from cluster_est.problem.search_space.space import make_space
from cluster_est.uncertainty.covariance.derivatives import _lengths


def space_of_two():
    problem = made_problem(5)
    model = problem.model
    two = tuple(Parameter(name, 1.0, 0.0, 10.0) for name in ("k", "l"))
    model = type(model)(model.name, b"", model.interface, model.solver, ("k", "l"))
    return make_space(Problem(model, two, problem.experiments), (0,))


@pytest.mark.parametrize("room", [0.0, 1e-9])
def test_an_unknown_at_its_bound_ends_only_steps_that_move_it(room):
    space = space_of_two()
    directions = np.array([[1.0, 0.0], [0.0, 1.0]])
    lengths, _ = _lengths(space, np.array([1.0, room]), directions)
    assert lengths[1] == room
    assert lengths[0] > 1e-6
