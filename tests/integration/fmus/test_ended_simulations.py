import math
import re
from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import spring_problem
from support.simulated import answers as simulated

from cluster_est import Problem, Solver
from workers.messages import Effect, Outcome, Status, Task, Want

SOLVERS = {
    "dormand_prince": Solver("dormand_prince"),
    "rk4": Solver("rk4", step=0.01),
    "cvode": Solver("cvode", rtol=1e-8),
    "fmu": Solver("fmu"),
}
OFF = np.array([1.6, 22.0, 1.0, 0.1])
"""Values of the parameters at which the residuals are some tenths."""


def problem(solver: str) -> Problem:
    interface = "co_simulation" if solver == "fmu" else "model_exchange"
    return spring_problem(1, solver=SOLVERS[solver], interface=interface).problem


def answers(found: Problem, *bounds: float, want: Want = "residuals") -> list[Outcome]:
    """The outcomes of one point with several bounds, asked for in one batch."""
    tasks = [Task(i, 0, OFF, want, bound=bound) for i, bound in enumerate(bounds)]
    return simulated(found.model, found.experiments, tasks)


@pytest.mark.parametrize("solver", SOLVERS)
def test_it_ends_at_the_first_time_at_which_the_sum_is_above_the_bound(solver):
    found = problem(solver)
    (whole,) = answers(found, math.inf)
    assert whole.residuals is not None
    partial = np.cumsum(whole.residuals**2)
    times = found.experiments[0].outputs[0].times
    bounds = [share * partial[-1] for share in (0.001, 0.3, 0.99)]
    *ended, above, free = answers(found, *bounds, 1.001 * partial[-1], math.inf)
    for bound, outcome in zip(bounds, ended, strict=True):
        first = times[int(np.argmax(partial > bound))]
        assert outcome.status is Status.ENDED_EARLY
        assert re.search(
            f"squares had already exceeded the limit.* at t = {first:.9g} s", outcome.message
        )
        assert outcome.residuals is None
        assert (outcome.ok, outcome.failed) == (False, False)
    for outcome in (above, free):  # those that were ended before it leave no trace
        assert outcome.residuals is not None
        assert outcome.residuals.tobytes() == whole.residuals.tobytes()


def test_several_outputs_are_summed_in_the_order_of_their_times():
    found = problem("rk4")
    (run,) = found.experiments
    (y,) = run.outputs
    late = replace(y, variable="v", times=y.times[5::7], values=0.3 * y.values[5::7], sigma=0.5)
    run = replace(run, outputs=(late, replace(y, times=y.times[1::2], values=y.values[1::2])))
    found = replace(found, experiments=(run,))
    (whole,) = answers(found, math.inf)
    assert whole.residuals is not None
    times = np.concatenate([output.times for output in run.outputs])
    order = np.argsort(times, kind="stable")
    partial = np.cumsum(whole.residuals[order] ** 2)
    for share in (0.1, 0.5, 0.9):
        (outcome,) = answers(found, share * partial[-1])
        first = times[order][int(np.argmax(partial > share * partial[-1]))]
        assert outcome.message.endswith(f"at t = {first:.9g} s")


def test_reduced_residuals_end_as_early_as_whole_ones():
    found = problem("rk4")
    (whole,) = answers(found, 0.05)
    (reduced,) = answers(found, 0.05, want="squares")
    assert whole.status is reduced.status is Status.ENDED_EARLY
    assert whole.message == reduced.message


def test_a_trajectory_that_is_asked_for_is_simulated_to_its_end():
    (outcome,) = answers(problem("rk4"), 1e-6, want="trajectory")
    assert outcome.ok


def test_with_effects_and_outputs_that_are_not_plain_it_goes_to_its_end():
    found = problem("rk4")
    effect = Effect("drag", "der(v)", equation="-d * v", coefficients=(("d", 0.1),))
    task = Task(0, 0, np.append(OFF, 0.1), effects=(effect,), bound=1e-6)
    (outcome,) = simulated(found.model, found.experiments, [task])
    assert outcome.ok, outcome.message
    (run,) = found.experiments
    free = replace(run, outputs=(replace(run.outputs[0], free_offset=True),))
    (outcome,) = answers(replace(found, experiments=(free,)), 1e-6)
    assert outcome.ok, outcome.message
