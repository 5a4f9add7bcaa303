"""What is packed for the way between machines comes out as it went in."""

from __future__ import annotations

import pickle
from dataclasses import fields

import numpy as np

from workers.messages import Linearisation, Outcome, Status, Trajectory
from workers.wire import OutcomeColumns

NAMES = {
    "state_names": ("x", "v", "lag:z"),
    "input_names": ("F",),
    "output_names": ("y",),
    "parameter_names": ("m", "k"),
}


def linearisation(seed: int) -> Linearisation:
    """Arrays of every size, so that no two could be mixed up."""
    generator = np.random.default_rng(seed)
    arrays = [f.name for f in fields(Linearisation) if f.name not in NAMES]
    return Linearisation(
        **{name: generator.normal(size=(4, 3, 1 + i)) for i, name in enumerate(arrays)}, **NAMES
    )


def same(one: Linearisation, other: Linearisation) -> bool:
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(Linearisation)]
    return all(np.array_equal(a, b) for a, b in pairs)


def test_outcomes_come_back_with_all_they_carry() -> None:
    trajectory = Trajectory(("y",), np.arange(2.0), np.ones((2, 1)))
    sent = [
        Outcome(7, Status.OK, np.arange(3.0), seconds=0.5, worker="w"),
        Outcome(3, Status.OK, np.arange(2.0), worker="w", linearisation=linearisation(0)),
        Outcome(4, Status.NOT_FINITE, message="too large", worker="w"),
        Outcome(5, Status.OK, np.zeros(0), trajectory, worker="w"),
        Outcome(6, Status.OK, np.arange(4.0), worker="w", linearisation=linearisation(1)),
        Outcome(8, Status.OK, np.zeros(0), worker="w", constraints=np.array([0.5, -1.0])),
        Outcome(9, Status.OK, np.arange(2.0), worker="w", constraints=np.array([np.nan])),
    ]
    got = pickle.loads(pickle.dumps(OutcomeColumns.of(sent))).outcomes()
    for before, after in zip(sent, got, strict=True):
        assert (after.task, after.status, after.message) == (
            before.task, before.status, before.message
        )  # fmt: skip
        assert (after.seconds, after.worker) == (before.seconds, before.worker)
        assert (after.residuals is None) == (before.residuals is None)
        if before.residuals is not None:
            np.testing.assert_array_equal(after.residuals, before.residuals, strict=True)
        np.testing.assert_array_equal(after.constraints, before.constraints, strict=True)
        assert (after.trajectory is None) == (before.trajectory is None)
        assert (after.linearisation is None) == (before.linearisation is None)
        if before.linearisation is not None:
            assert after.linearisation is not None
            assert same(before.linearisation, after.linearisation)
    assert not same(linearisation(0), linearisation(1))
