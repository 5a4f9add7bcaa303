import pickle
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from workers.messages import Effect, Linearisation, MatrixSeries, Outcome, Status, Task, Trajectory
from workers.wire import OutcomeColumns, TaskBatch

NAMES = {"state_names": ("x", "v", "lag:z"), "input_names": ("F",)}
NAMES |= {"output_names": ("y",), "parameter_names": ("m", "k")}
DEFAULT = Outcome(0, Status.OK)


def linearisation(seed: int) -> Linearisation:
    """Arrays of every size, so that no two could be mixed up."""
    generator = np.random.default_rng(seed)
    arrays = [f.name for f in fields(Linearisation) if f.name not in NAMES]
    return Linearisation(
        **{name: generator.normal(size=(4, 3, 1 + i)) for i, name in enumerate(arrays)}, **NAMES
    )


def same(one: Any, other: Any) -> bool:
    """Equal in type, in every field and in every element, NaN included."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        alike = one.dtype == other.dtype and one.shape == other.shape
        return bool(alike and np.array_equal(one, other, equal_nan=True))
    if is_dataclass(one):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    return bool(one == other)


def check_all_same(sent: list[Any], got: list[Any]) -> None:
    assert len(got) == len(sent)
    for before, after in zip(sent, got, strict=True):
        for field in fields(before):
            assert same(getattr(before, field.name), getattr(after, field.name)), field.name


def outcomes() -> list[Outcome]:
    """Every kind of answer, those with and without each field in turn."""
    trajectory = Trajectory(("y",), np.arange(2.0), np.ones((2, 1)))
    slopes = np.arange(6.0).reshape(3, 2)
    slopes[1, 1] = np.nan
    return [
        Outcome(7, Status.OK, np.arange(3.0), seconds=0.5, worker="w"),
        Outcome(3, Status.OK, np.arange(2.0), worker="w", linearisation=linearisation(0)),
        Outcome(10, Status.OK, np.arange(2.0), worker="w", steps=149),
        Outcome(4, Status.NOT_FINITE, message="too large", worker="w"),
        Outcome(5, Status.OK, np.zeros(0), trajectory, worker="w"),
        Outcome(6, Status.OK, np.arange(4.0), worker="w", linearisation=linearisation(1)),
        Outcome(8, Status.OK, np.zeros(0), worker="w", constraints=np.array([0.5, -1.0])),
        Outcome(9, Status.OK, np.arange(2.0), worker="w", constraints=np.array([np.nan])),
        Outcome(1, Status.OK, np.arange(3.0), worker="w", sensitivities=slopes),
        Outcome(2, Status.OK, np.arange(3.0), message="no derivatives", seconds=2.0, worker="w"),
        Outcome(0, Status.OK, np.ones(3), worker="w", sensitivities=2.0 * slopes),
    ]


def test_outcomes_come_back_with_all_they_carry():
    sent = outcomes()
    for field in fields(Outcome):
        carried = [getattr(outcome, field.name) for outcome in sent]
        assert not all(same(each, getattr(DEFAULT, field.name)) for each in carried), field.name
    check_all_same(sent, pickle.loads(pickle.dumps(OutcomeColumns.of(sent))).outcomes())
    assert OutcomeColumns.of([]).outcomes() == []


def test_tasks_come_back_with_all_they_carry():
    effects = (Effect("drag", "der(v)", "linear", ("v",)),)
    generator = np.random.default_rng(0)
    sent = [
        Task(number, experiment, generator.normal(size=3), "sensitivities", effects, bound)
        for number, experiment, bound in ((5, 1, 0.1), (2, 0, np.inf), (9, 1, 3.0))
    ]
    check_all_same(sent, pickle.loads(pickle.dumps(TaskBatch.of(sent))).tasks())


def test_a_batch_of_tasks_that_want_different_things_is_refused():
    values, drag = np.zeros(1), Effect("drag", "der(v)", "linear", ("v",))
    for other in (Task(1, 0, values, "trajectory"), Task(1, 0, values, effects=(drag,))):
        with pytest.raises(ValueError, match="all tasks in it must ask for the same"):
            TaskBatch.of([Task(0, 0, values), other])


MATRICES = arrays(float, (4, 2, 3), elements=st.sampled_from([0.0, 0.0, 0.0, 1.5, -2.0, np.inf]))


@given(MATRICES)
def test_nothing_is_lost(matrices):
    series = MatrixSeries.of(matrices)
    np.testing.assert_array_equal(np.asarray(series), matrices)
    np.testing.assert_array_equal(series.at(2), matrices[2])
    np.testing.assert_array_equal(series.row(1), matrices[:, 1])
    np.testing.assert_array_equal(series.largest(), np.abs(matrices).max(axis=0))
    assert series.values.shape[1] == (matrices != 0.0).any(axis=0).sum()


def test_what_is_no_number_is_kept():
    matrices = np.zeros((3, 2, 2))
    matrices[1, 0, 1] = np.nan
    assert np.isnan(MatrixSeries.of(matrices).values[1, 0])


def test_entries_that_are_not_kept_cannot_be_shared():
    with pytest.raises(ValueError, match="copied"):
        np.asarray(MatrixSeries.of(np.ones((2, 1, 1))), copy=False)
