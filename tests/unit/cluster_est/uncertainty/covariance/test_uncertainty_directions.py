"""What the data do not determine is named; what they do is not."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.problems.curves import Curves

from cluster_est import LeastSquares, Parameter
from cluster_est.methods.method import Ending, Solution
from cluster_est.problem.costs import GaussianLikelihood
from cluster_est.uncertainty import assess, examine, linearise

TIMES = np.linspace(0.1, 4.0, 30)
NAMES = "abcd"


def curves(formula, truth, starts=None, count=1, scale="linear", per=()):
    """A formula of parameters a, b, c, ... with noise."""
    generator = np.random.default_rng(7)
    measured = [
        formula(TIMES, truth, e) + 0.01 * generator.normal(size=len(TIMES)) for e in range(count)
    ]
    parameters = tuple(
        Parameter(
            NAMES[i],
            value,
            (1e-3 if scale == "log" else -100.0, 100.0),
            scale=scale,
            per="experiment" if NAMES[i] in per else None,
        )
        for i, value in enumerate(starts or truth)
    )
    return Curves(formula, parameters, TIMES, measured)


def ratio(times, values, experiment):
    a, b, c, d = values
    return d + np.exp(-a / b * times) * np.cos(c / b * times)


def product(times, values, experiment):
    return values[0] * values[1] * np.exp(-values[2] * times)


def total(times, values, experiment):
    return (values[0] + values[1]) * np.exp(-times)


def square(times, values, experiment):
    return values[0] ** 2 / values[1] * np.exp(-times) + values[2]


def unused(times, values, experiment):
    return values[0] * np.exp(-times)


def two_pairs(times, values, experiment):
    a, b, c, d = values
    return a * b * np.exp(-times) + c / d * np.cos(times)


TOGETHER = "the data determine {} only in combination: .*{}.* without changing any residual"
CASES = {
    "by the same factor": (
        ratio,
        (0.5, 2.0, 6.0, 1.0),
        {"abc": TOGETHER.format("a, b and c", "all of them can grow by the same factor")},
    ),
    "by inverse factors": (
        product,
        (2.0, 3.0, 1.0),
        {"ab": TOGETHER.format("a and b", "a can grow by the factor by which b falls")},
    ),
    "in a ratio": (
        square,
        (2.0, 3.0, 1.0),
        {"ab": TOGETHER.format("a and b", "can grow in the ratio 1 : 3")},
    ),
    "up and down": (
        total,
        (2.0, 3.0),
        {"ab": TOGETHER.format("a and b", "a can grow by 1 % while b falls by 0.667 %")},
    ),
    "no effect": (unused, (2.0, 3.0), {"b": "b has no effect on any residual"}),
    "two pairs": (
        two_pairs,
        (2.0, 3.0, 1.0, 4.0),
        {
            "ab": TOGETHER.format("a and b", "a can grow by the factor by which b falls"),
            "cd": TOGETHER.format("c and d", "both can grow by the same factor"),
        },
    ),
}


def at_truth(case, truth, differences="central", **options):
    problem = curves(case, truth, **options)
    runner, space = problem.runner(), problem.space()
    if differences == "central":
        return runner, space, linearise(runner, space, Solution(space.start, 1.0, Ending.CONVERGED))
    forward = LeastSquares(differences="forward", max_iterations=0)
    _, _, solution = problem.solve(forward)
    return runner, space, solution


def check_names(found, said):
    """Whether the directions are those, each named in its words."""
    assert sorted("".join(d.labels) for d in found.directions) == sorted(said)
    for direction in found.directions:
        assert re.search(said["".join(direction.labels)], direction.sentence)


@pytest.mark.parametrize("differences", ["forward", "central"])
@pytest.mark.parametrize("name", CASES)
def test_what_is_not_determined_is_named_and_has_no_interval(name, differences):
    case, truth, said = CASES[name]
    runner, space, solution = at_truth(case, truth, differences)
    check_names(assess(space, solution), said)  # from the derivatives alone
    before = runner.evaluations
    found = examine(runner, space, solution)
    check_names(found, said)
    assert runner.evaluations - before == 4 * len(said)
    for direction in found.directions:
        assert direction.ratio < 1e-9
        assert direction.kind == ("no effect" if name == "no effect" else "undetermined")
    errors = {u.label: i.std_error for u, i in zip(space.unknowns, found.intervals, strict=True)}
    assert {label for label, error in errors.items() if np.isnan(error)} == set("".join(said))
    inverse = np.linalg.pinv(solution.jacobian, rcond=1e-4)
    expected = np.sqrt(np.diag(inverse @ inverse.T) * found.variance)
    for error, known in zip(errors.values(), expected, strict=True):
        assert np.isnan(error) or error == pytest.approx(known, rel=1e-4)


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_weights_are_the_move_in_each_unknowns_unit(scale):
    _, space, solution = at_truth(ratio, (0.5, 2.0, 6.0, 1.0), scale=scale)
    (found,) = assess(space, solution).directions
    np.testing.assert_allclose(found.weights, (1.0, 4.0, 12.0), rtol=1e-5)
    np.testing.assert_allclose(found.relative, 1.0, rtol=1e-5)
    assert "by the same factor" in found.sentence


def examined(problem):
    """What is found where an estimation would begin."""
    space = problem.space()
    return examine(problem.runner(), space, Solution(space.start, 1.0, Ending.CONVERGED))


def test_shared_and_local_unknowns_together():
    def offsets(times, values, experiment):
        return values[0] + values[1] + values[2] * times

    (found,) = examined(curves(offsets, (2.0, 3.0, 1.0), count=3, per=("b",))).directions
    assert found.labels == ("a", "b[e0]", "b[e1]", "b[e2]")
    np.testing.assert_allclose(found.weights, (1.0, -1.0, -1.0, -1.0), rtol=1e-6)
    assert "b[e0] falls by 0.667 %, b[e1] falls by 0.667 % and b[e2] falls" in found.sentence


@pytest.mark.parametrize("room", [101.0, 0.0])
def test_local_unknowns_of_one_experiment_alone(room):
    """Another unknown at its bound leaves steps that do not move it their length."""

    def sometimes(times, values, experiment):
        level = values[0] * values[1] if experiment == 1 else values[0] + values[1] * times
        return level + values[2] * times**2

    problem = curves(sometimes, (2.0, 3.0, 1.0), count=3, per=("a", "b"))
    *ab, c = problem.parameters
    problem = replace(problem, parameters=(*ab, replace(c, bounds=(c.start - room, c.upper))))
    found = examined(problem)
    (direction,) = found.directions
    assert direction.labels == ("a[e1]", "b[e1]")
    assert found.notes == ()
    labels = [u.label for u in problem.space().unknowns]
    lacking = [np.isnan(interval.std_error) for interval in found.intervals]
    held = () if room else ("c",)
    named = [x for x, bad in zip(labels, lacking, strict=True) if bad]
    assert sorted(named) == sorted((*direction.labels, *held))


def test_an_experiment_with_fewer_residuals_than_unknowns_loses_what_it_lacks():
    def powers(times, values, experiment):
        return values[0] * np.exp(-times) + np.polyval(values[1:], times)

    full = curves(powers, (2.0, 3.0, 1.0, 0.5), count=3, per="bcd")
    short = replace(full, times=TIMES[:2], measured=[each[:2] for each in full.measured])
    found, space = examined(short), short.space()
    assert len(found.directions) == space.size - 6
    assert {label for each in found.directions for label in each.labels} == {
        unknown.label for unknown in space.unknowns
    }


def nearly(times, values, experiment):
    """b is told from a by a millionth of what it does."""
    a, b, c = values
    return (a + b) * np.exp(-times) + 2e-7 * b * np.cos(9.0 * times) + c


def test_what_hardly_shows_is_called_weak_where_the_derivatives_can_tell():
    runner, space, solution = at_truth(nearly, (2.0, 3.0, 1.0))
    (found,) = examine(runner, space, solution).directions
    assert found.kind == "weak"
    assert found.labels == ("a", "b")
    assert re.search(
        "hardly distinguish a and b.*a grows by 1 % while b falls by 0.667 %", found.sentence
    )


def test_noise_of_the_simulation_does_not_make_a_lost_direction_look_determined():
    """As of a solver whose number of steps changes: along the direction itself there is none."""

    def noisy(times, values, experiment):
        a, b, c, _ = values
        noise = 1e-8 * (np.sin(1e8 * a / b) + np.sin(1e8 * c / b))
        return ratio(times, values, experiment) + noise * np.cos(7.0 * times)

    runner, space, solution = at_truth(noisy, (0.5, 2.0, 6.0, 1.0))
    assert assess(space, solution).directions == ()  # from the differences alone
    (found,) = examine(runner, space, solution).directions
    assert re.search(CASES["by the same factor"][2]["abc"], found.sentence)


def decay(times, values, experiment):
    a, b, c = values
    return a * np.exp(-b * times) + c


def two(times, values, experiment):
    """Exponentials of nearly the same rate: correlated by more than 0.9999."""
    return values[0] * np.exp(-times) + values[1] * np.exp(-1.02 * times)


@pytest.mark.parametrize(
    ("formula", "truth", "differences"),
    [
        (decay, (2.0, 1.0, 0.5), "forward"),
        (decay, (2.0, 1.0, 0.5), "central"),
        (two, (2.0, 1.0), "central"),
    ],
)
def test_a_determined_problem_has_none_however_correlated(formula, truth, differences):
    runner, space, solution = at_truth(formula, truth, differences)
    before = runner.evaluations
    found = examine(runner, space, solution)
    assert found.directions == ()
    assert formula is two or runner.evaluations == before
    assert formula is decay or found.correlations[0, 1] < -0.9999


def test_constraints_may_determine_what_the_data_do_not():
    found = examined(replace(curves(total, (2.0, 3.0)), constraints=("b == 1.5 * a",)))
    assert found.directions == ()
    assert np.isfinite([interval.std_error for interval in found.intervals]).all()


def test_failed_simulations_leave_the_derivatives_as_they_are():
    def walled(times, values, experiment):
        a, b, c = values
        fine = abs(a - 2.0) < 1e-4 and abs(b - 3.0) < 1e-4
        return a * b * np.exp(-c * times) if fine else np.full(len(times), np.nan)

    runner, space, solution = at_truth(walled, (2.0, 3.0, 1.0))
    found = examine(runner, space, solution)
    assert [direction.labels for direction in found.directions] == [("a", "b")]
    assert "could not be checked by simulations" in found.notes[0]


def test_an_unknown_whose_differences_fail_is_not_said_to_have_no_effect():
    """The offset can only be simulated where it starts, and the data pull it away."""

    def walled(times, values, experiment):
        slope, offset = values
        return slope * times + offset if offset == 5.2 else np.full(len(times), np.nan)

    measured = [4.8 + TIMES]
    parameters = (Parameter("a", 0.5), Parameter("b", 5.2))
    runner, space, solution = Curves(walled, parameters, TIMES, measured).solve()
    assert not solution.ending.success
    found = examine(runner, space, solution)
    assert found.directions == ()
    (note,) = found.notes
    assert re.search("no intervals, because.*derivatives with respect to b failed", note)
    assert all(np.isnan(each.std_error) for each in found.intervals)


def test_a_direction_that_cannot_be_measured_does_not_keep_others_from_it():
    """One unknown without effect stands at its bound; a kink hides that two others are one."""

    def kinked(times, values, experiment):
        a, b, c, _ = values
        return a * b * np.exp(-c * times) + 1e-6 * np.sin(1e7 * a)

    problem = curves(kinked, (2.0, 3.0, 1.0, 0.0))
    bounded = (*problem.parameters[:3], Parameter("d", 0.0, (0.0, 100.0)))
    problem = replace(problem, parameters=bounded)
    runner, space = problem.runner(), problem.space()
    solution = linearise(runner, space, Solution(space.start, 1.0, Ending.CONVERGED))
    before = runner.evaluations
    found = examine(runner, space, solution)
    assert runner.evaluations > before
    assert {d.labels for d in found.directions} >= {("d",)}
    assert "could not be checked by simulations" in found.notes[0]


def test_directions_are_measured_where_some_simulations_fail():
    def patchy(times, values, experiment):
        a, b, c = values
        drawn = np.random.default_rng(np.array(values).view(np.uint32)).random()
        start = np.array_equal(values, (2.0, 3.0, 1.0))
        fine = drawn > 0.15 or start
        return a * b * np.exp(-c * times) if fine else np.full(len(times), np.nan)

    runner, space, solution = at_truth(patchy, (2.0, 3.0, 1.0))
    assert not solution.frozen.any()
    found = examine(runner, space, solution)
    check_names(found, CASES["by inverse factors"][2])
    assert not any("could not be checked by simulations" in note for note in found.notes)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_an_output_that_is_followed_exactly_tells_its_noise_to_no_likelihood(scale):
    def line(times, values, experiment):
        return scale * (values[0] + values[1] * times + values[2] * times**2)

    parameters = tuple(Parameter(name, 1.0) for name in "abc")
    times = np.array([0.0, 1.0])
    measured = [line(times, (1.0, 1.0, 1.0), 0)]
    problem = Curves(line, parameters, times, measured, cost=GaussianLikelihood())
    runner, space, solution = problem.solve()
    found = examine(runner, space, solution)
    assert [d.labels for d in found.directions] == [("b", "c")]
    assert np.isnan([interval.std_error for interval in found.intervals]).all()
    assert any("the residuals of an output are 0" in note for note in found.notes)
