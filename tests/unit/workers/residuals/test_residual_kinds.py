import pickle
import re
import subprocess
import sys
import textwrap
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.problems.springs import FMU
from support.simulated import answers

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import (
    Curve,
    Experiment,
    Input,
    Model,
    Output,
    SignalBound,
    Solver,
    Status,
    Task,
    UserFunction,
)
from workers.residuals.comparison import SimulatedOutputs
from workers.residuals.experiment_residuals import SignalBounds
from workers.residuals.functions import FunctionComparison
from workers.residuals.nearest_segment import segment_distances, tolerance_constraints

TIMES = np.linspace(0.0, 2.0, 41)
MODEL = Model(
    "spring.fmu", FMU.read_bytes(), "model_exchange", Solver("dormand_prince"), ("m", "k")
)
POINTS = np.array([[1.0, 25.0], [1.3, 30.0], [-1.0, 25.0], [0.7, 18.0], [2.0, 40.0]])
SOURCE = """
import numpy as np

def residuals(run):
    return run.residuals("y")

def energy(run):
    return float(np.max(0.5 * run.values["m"] * run.simulated["v"] ** 2)) - 0.02

def fails_for_light(run):
    if run.values["m"] < 1.0:
        raise RuntimeError("too light")
    return run.simulated["y"][:3]
"""


def function(name, source=SOURCE):
    return UserFunction("mine", name, source)


SHOWN = Output("y", TIMES[::2], 0.1 * np.cos(TIMES[::2]), 0.5)
EXPERIMENT = Experiment("run 1", 0.0, 2.0, (Input("F", TIMES, np.sin(3.0 * TIMES)),), (SHOWN,))
BOUND = SignalBound(
    "speed", "v", np.linspace(0.0, 2.0, 33), np.full(33, -0.2), np.full(33, 0.15), 0.1
)
LOOP = Curve(("x", "v"), np.array([[0.0, 0.0], [0.05, 0.1], [0.1, 0.0], [0.0, -0.1]]),
             np.linspace(0.0, 2.0, 21), (0.1, 0.2))  # fmt: skip
EVERYTHING = replace(
    EXPERIMENT, curve=LOOP, bounds=(BOUND,), constraint_functions=(function("energy"),)
)


def ask(experiment, points, want="residuals"):
    tasks = [Task(i, 0, values, want) for i, values in enumerate(points)]
    return answers(MODEL, [experiment], tasks)


def simulated(signal, times, name="y"):
    """(points, n) of one variable."""
    return SimulatedOutputs(times, (name,), np.asarray(signal, float)[:, :, None], np.zeros((1, 1)))


def bound(lower, upper, **more):
    ones = np.ones(len(TIMES))
    return SignalBound("b", "y", TIMES, lower * ones, upper * ones, **more)


@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_the_largest_violation_of_each_side(seed, points):
    generator = np.random.default_rng(seed)
    lower, upper = np.sort(generator.normal(size=(2, len(TIMES))), axis=0)
    lower[generator.random(len(TIMES)) < 0.3] = -np.inf
    upper[generator.random(len(TIMES)) < 0.3] = np.inf
    signal = generator.normal(size=(points, len(TIMES)))
    found = SignalBounds((bound(lower, upper, scale=2.0),)).compare(simulated(signal, TIMES)).values
    for row, values in zip(found, signal, strict=True):
        below = max((a - y) / 2.0 for a, y in zip(lower, values, strict=True) if np.isfinite(a))
        above = max((y - b) / 2.0 for b, y in zip(upper, values, strict=True) if np.isfinite(b))
        assert row.tolist() == [below, above]


def violations(bounds, signal):
    """What points violate whose signal is that; (points, n)."""
    rows = np.atleast_2d(np.asarray(signal, float) * np.ones(len(TIMES)))
    return SignalBounds(bounds).compare(simulated(rows, TIMES)).values.tolist()


def test_an_equality_keeps_the_gap_that_is_farthest_and_its_sign():
    signal = np.zeros((2, len(TIMES)))
    signal[0, 3], signal[0, 7] = 0.5, -0.75
    signal[1, 4] = 2.0
    assert violations((bound(0.0, 0.0, scale=0.5, equality=True),), signal) == [[-1.5], [4.0]]


def test_bounds_look_at_their_own_times_only():
    some = SignalBound("b", "y", TIMES[5:8], np.zeros(3), np.full(3, np.inf))
    signal = np.full(len(TIMES), -9.0)
    signal[5:8] = [1.0, 2.0, 3.0]
    assert violations((some,), signal) == [[-1.0]]


def test_several_bounds_stand_one_after_the_other_as_their_names_do():
    """One without limits is no constraint."""
    nothing = bound(-np.inf, np.inf)
    bounds = (bound(-1.0, np.inf), nothing, bound(-np.inf, 2.0), bound(0.0, 0.0, equality=True))
    experiment = replace(EXPERIMENT, bounds=bounds)
    assert experiment.constraint_names == ("b lower", "b upper", "b")
    assert experiment.equality == (False, False, True)
    assert violations(bounds, 5.0) == [[-6.0, 3.0, 5.0]]


def test_a_signal_that_is_no_number_violates_nothing_in_silence():
    signal = np.zeros((2, len(TIMES)))
    signal[0, 10] = np.nan
    first, second = violations((bound(-1.0, 1.0),), signal)
    assert np.isnan(first).all()
    assert second == [-1.0, -1.0]


def test_violations_that_overflow_are_an_outcome():
    tiny = 5e-324
    for spoiled in (
        replace(EXPERIMENT, bounds=(replace(BOUND, scale=tiny),)),
        replace(EXPERIMENT, curve=replace(LOOP, tolerances=(tiny, 0.0))),
    ):
        (outcome,) = ask(spoiled, np.array([[1.2, 30.0, 0.6]])[:, : len(MODEL.parameters)])
        assert outcome.status is Status.NOT_FINITE
        assert "so large that" in outcome.message


@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["x and v", "v and x"])
def test_what_an_experiment_has_comes_in_the_order_of_its_names(order):
    """Those of curves in that of their variables."""
    names = tuple("xv"[k] for k in order)
    tolerances = tuple(LOOP.tolerances[k] for k in order)
    turned = Curve(names, LOOP.points[:, list(order)], LOOP.times, tolerances)
    experiment = replace(EVERYTHING, curve=turned)
    (outcome,) = ask(experiment, POINTS[:1], "trajectory")
    assert outcome.ok
    assert experiment.constraint_names == (
        *(f"tolerance of {name}" for name in names), "speed lower", "speed upper", "energy"
    )  # fmt: skip
    assert experiment.recorded == ("y", *names)
    assert experiment.size == 21 + 3 == len(outcome.residuals)
    trajectory = outcome.trajectory
    signal = dict(zip(trajectory.variables, trajectory.values.T, strict=True))

    def at(name, times):
        return signal[name][np.searchsorted(trajectory.times, times)]

    measured = EXPERIMENT.outputs[0]
    expected = (measured.values - at("y", measured.times)) / 0.5
    np.testing.assert_array_equal(outcome.residuals[:21], expected)
    points = np.column_stack([at(name, turned.times) for name in names])
    np.testing.assert_array_equal(outcome.residuals[21:], segment_distances(points, turned.points))
    farthest = tolerance_constraints(points, turned.points, np.array(tolerances))
    np.testing.assert_array_equal(outcome.constraints[:2], farthest)
    v = at("v", BOUND.times)
    np.testing.assert_array_equal(
        outcome.constraints[2:4], [np.max(-0.2 - v) / 0.1, np.max(v - 0.15) / 0.1]
    )
    assert outcome.constraints[4] == np.max(0.5 * 1.0 * signal["v"] ** 2) - 0.02


def bits(outcome):
    residuals = b"" if outcome.residuals is None else outcome.residuals.tobytes()
    return outcome.status, outcome.message, residuals, outcome.constraints.tobytes()


USER = replace(EVERYTHING, cost_function=function("residuals"))
SCALAR = replace(EXPERIMENT, cost_function=function("energy"), bounds=(BOUND,))
ALONE: dict[tuple[str, int], tuple] = {}


@settings(max_examples=15)
@given(
    st.sampled_from([EVERYTHING, USER, SCALAR]),
    st.lists(st.integers(0, len(POINTS) - 1), min_size=1, max_size=8),
)
def test_no_answer_depends_on_its_batch(experiment, chosen):
    for i in set(chosen):
        if (experiment.key, i) not in ALONE:
            ALONE[experiment.key, i] = bits(ask(experiment, POINTS[[i]])[0])
    together = ask(experiment, POINTS[chosen])
    assert [bits(o) for o in together] == [ALONE[experiment.key, i] for i in chosen]
    assert [o.ok for o in together] == [i != 2 for i in chosen]


def test_a_function_that_gives_the_residuals_gives_the_same_bits():
    plain = ask(EXPERIMENT, POINTS)
    own = ask(replace(EXPERIMENT, cost_function=function("residuals")), POINTS)
    assert [bits(o) for o in own] == [bits(o) for o in plain]


def test_the_key_of_an_experiment_knows_all_of_it():
    limits = replace(BOUND, upper=BOUND.upper + 1.0)
    variants = [
        EXPERIMENT,
        EVERYTHING,
        replace(EVERYTHING, bounds=(limits,)),
        replace(EVERYTHING, bounds=(replace(BOUND, scale=0.2),)),
        replace(EVERYTHING, bounds=()),
        replace(EVERYTHING, curve=replace(LOOP, tolerances=(0.1, 0.3))),
        replace(EVERYTHING, curve=replace(LOOP, times=LOOP.times[1:])),
        replace(EVERYTHING, curve=replace(LOOP, points=LOOP.points + 1.0)),
        replace(EVERYTHING, constraint_functions=(function("energy", SOURCE + "\n"),)),
        replace(EVERYTHING, constraint_functions=(replace(function("energy"), equality=True),)),
        USER,
        replace(EVERYTHING, constraint_functions=(), cost_function=function("energy")),
    ]
    assert len({e.key for e in variants}) == len(variants)
    label = replace(EVERYTHING, constraint_functions=(replace(function("energy"), label="E"),))
    assert label.key == EVERYTHING.key
    assert label.constraint_names[-1] == "E"


def user(body):
    return UserFunction(
        "mine", "f", "import numpy as np\ndef f(run):\n" + textwrap.indent(body, "    ")
    )


@pytest.mark.parametrize(
    ("body", "phrase"),
    [
        ("return 1 / 0", "ZeroDivisionError: division by zero"),
        ("return run.nothing", "AttributeError"),
        ("return run.simulated['q']", "KeyError: 'q'"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("raise ValueError", "ValueError"),
        ("return 'many'", "could not convert string to float"),
        ("return {'a': 1}", "TypeError"),
        ("return None", "it must return real numbers, but returned a NoneType"),
        ("pass", "it must return real numbers, but returned a NoneType"),
        ("return 1j", "it must return real numbers, but returned a complex"),
        ("return np.fft.fft(run.simulated['y'])", "it must return real numbers, but returned"),
        ("return float('nan')", "it must return finite numbers, but returned nan"),
        ("return [1.0, float('-inf')]", "but returned"),
        ("return []", "but returned none"),
        ("return [[1.0], [1.0, 2.0]]", "ValueError"),
        ("run.simulated['y'][:] = 0.0\nreturn 0.0", "read-only"),
        ("run.measured['y'][1][:] = 0.0\nreturn 0.0", "read-only"),
        ("run.times[0] = 1.0\nreturn 0.0", "read-only"),
    ],
)
@pytest.mark.parametrize("place", ["cost_function", "constraint_functions"])
def test_a_function_that_misbehaves_is_a_failed_evaluation_that_says_why(body, phrase, place):
    each = user(body)
    experiment = replace(EXPERIMENT, **{place: each if place == "cost_function" else (each,)})
    for outcome in ask(experiment, POINTS[:2]):
        assert outcome.status is Status.NOT_FINITE
        assert outcome.message.startswith("mine:f failed (")
        assert phrase in outcome.message
        assert outcome.residuals is None
        assert len(outcome.constraints) == 0


@pytest.mark.parametrize("first", [0, 2, 3])
def test_a_failure_spares_its_neighbours(first):
    """Even where nobody knows yet how many numbers the function returns."""
    each = replace(EXPERIMENT, cost_function=function("fails_for_light"))
    found = ask(each, np.roll(POINTS, -first, axis=0))
    outcomes = [found[i - first] for i in range(len(POINTS))]
    assert [o.ok for o in outcomes] == [True, True, False, False, True]
    assert outcomes[2].status is Status.SOLVER_FAILURE
    assert "mass must be positive" in outcomes[2].message
    assert outcomes[3].message == "mine:fails_for_light failed (RuntimeError: too light)"
    assert [len(o.residuals) for o in outcomes if o.residuals is not None] == [3, 3, 3]


def test_outputs_that_are_not_finite_are_said_to_be_even_behind_a_function():
    record = np.zeros((2, 5, 1))
    record[0, 3] = np.nan
    seen = SimulatedOutputs(np.arange(5.0), ("y",), record, np.zeros((2, 2)))
    comparison = FunctionComparison(user("return 1.0"), EXPERIMENT, ("m", "k"), single=False)
    compared = comparison.compare(seen)
    assert list(compared.failures) == [0]
    assert compared.values[1].tolist() == [1.0]


@pytest.mark.parametrize(
    ("body", "value"),
    [("return np.array([[7.0]])", 7.0), ("return 3", 3.0), ("return True", 1.0),
     ("return np.float32(2)", 2.0)],
)  # fmt: skip
def test_a_constraint_returns_one_number(body, value):
    (outcome,) = ask(replace(EXPERIMENT, constraint_functions=(user(body),)), POINTS[:1])
    assert outcome.constraints.tolist() == [value]
    two = user("return [1.0, 2.0]")
    (outcome,) = ask(replace(EXPERIMENT, constraint_functions=(two,)), POINTS[:1])
    assert "must return one number, but returned 2" in outcome.message


def test_a_cost_function_returns_as_many_numbers_each_time():
    each = replace(EXPERIMENT, cost_function=user("return np.ones(2 + (run.values['m'] > 1.1))"))
    good, bad = ask(each, POINTS[[0, 1]])
    assert good.residuals.tolist() == [1.0, 1.0]
    assert re.search("must return 2 numbers.*but returned 3", bad.message)


def test_what_a_function_is_given():
    body = """
assert run.experiment == "run 1"
assert sorted(run.simulated) == ["v", "x", "y"]
assert list(run.measured) == ["y"] and run.sigma == {"y": 0.5}
assert run.values == {"m": 1.0, "k": 25.0}
times, values = run.measured["y"]
assert len(times) == len(values) == 21
assert all(len(column) == len(run.times) for column in run.simulated.values())
assert run.times[0] == 0.0 and run.times[-1] == 2.0
return run.residuals("y")
"""
    each = replace(EVERYTHING, cost_function=user(body), constraint_functions=())
    (outcome,) = ask(each, POINTS[:1])
    assert outcome.ok, outcome.message


def test_a_function_cannot_spoil_what_others_see():
    spoils = user("for v in run.simulated.values():\n    v = v * 0\nrun.values.clear()\nreturn 0.0")
    plain = ask(EXPERIMENT, POINTS)
    beside = ask(replace(EXPERIMENT, constraint_functions=(spoils, spoils)), POINTS)
    for one, other in zip(plain, beside, strict=True):
        assert bits(one)[2] == bits(other)[2]


def test_source_text_works_in_another_process(tmp_path):
    experiment = replace(EVERYTHING, cost_function=function("residuals"))
    packed = tmp_path / "job.pickle"
    packed.write_bytes(pickle.dumps((MODEL, experiment, POINTS)))
    script = textwrap.dedent(
        f"""
        import pickle, sys
        model, experiment, points = pickle.loads(open({str(packed)!r}, "rb").read())
        from workers.evaluate import Evaluator
        from workers.messages import Task
        from workers.wire import OutcomeColumns, TaskBatch
        batch = TaskBatch.of([Task(i, 0, values) for i, values in enumerate(points)])
        outcomes = Evaluator(model, [experiment], "w").evaluate(batch)
        sys.stdout.buffer.write(pickle.dumps(OutcomeColumns.of(outcomes)))
        """
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, check=True
    )
    elsewhere = pickle.loads(done.stdout).outcomes()
    assert [bits(o) for o in elsewhere] == [bits(o) for o in ask(experiment, POINTS)]


def test_a_worker_that_lacks_the_module_says_so():
    for each in (UserFunction("no_such_module", "f"), UserFunction("math", "no_such")):
        with pytest.raises(ModelError, match=f"{each.module}:{each.name}: must be a function"):
            Evaluator(MODEL, [replace(EXPERIMENT, cost_function=each)], "w")


def test_each_worker_has_a_module_of_its_own():
    """One that counts its calls begins anew with each."""
    counts = user("calls.append(run)\nreturn len(calls)")
    counts = replace(counts, source="calls = []\n" + counts.source)
    for _ in range(2):
        outcomes = ask(replace(EXPERIMENT, cost_function=counts), POINTS[[0, 1]])
        assert [o.residuals.tolist() for o in outcomes] == [[1.0], [2.0]]
