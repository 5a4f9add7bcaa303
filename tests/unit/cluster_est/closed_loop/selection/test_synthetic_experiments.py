"""Experiments that nobody measured."""

from __future__ import annotations

import numpy as np

from cluster_est.closed_loop.synthetic_experiments import (
    EnlargedCopy,
    ShortenedCopy,
)
from workers.messages import Experiment, Input, Output

T = np.linspace(10.0, 20.0, 101)
RUN = Experiment(
    "run", 10.0, 20.0, (Input("u", T, 2.0 + np.sin(T), "hold"),),
    (Output("y", T, T**2, 0.3), Output("z", T[::5], np.cos(T[::5]))), (("x", 1.0),),
    groups=(("rig", "a"),), signals=(Input("w", T, T),),
)  # fmt: skip


def test_a_part_has_the_measurements_until_its_end():
    part = ShortenedCopy(0.6).of(RUN)
    assert (part.start, part.stop) == (10.0, 16.0)
    first, second = part.outputs
    np.testing.assert_array_equal(first.times, T[T <= 16.0])
    np.testing.assert_array_equal(first.values, T[T <= 16.0] ** 2)
    np.testing.assert_array_equal(second.values, np.cos(second.times))
    assert (first.sigma, part.values, part.groups) == (0.3, RUN.values, RUN.groups)
    assert part.id != RUN.id


def test_a_part_is_as_long_as_each_output_needs():
    part = ShortenedCopy(0.01).of(RUN)
    assert len(part.outputs[1].times) >= ShortenedCopy(0.01).samples
    assert part.stop == T[::5][ShortenedCopy(0.01).samples - 1]


def test_a_record_that_is_too_short_stays_whole():
    few = Experiment("few", 0.0, 5.0, (), (Output("y", np.arange(1.0, 5.0), np.zeros(4)),))
    part = ShortenedCopy(0.15).of(few)
    assert part.stop == 4.0
    assert part.outputs[0].times.tolist() == [1.0, 2.0, 3.0, 4.0]


def test_inputs_swing_further_about_their_means():
    (given,) = EnlargedCopy(1.25).of(RUN).inputs
    old = RUN.inputs[0].values
    assert np.isclose(given.values.mean(), old.mean())
    np.testing.assert_allclose(np.ptp(given.values), 1.25 * np.ptp(old))
    np.testing.assert_allclose(given.values - old, 0.25 * (old - old.mean()), atol=1e-14)
    assert given.interpolation == "hold"
    assert EnlargedCopy(1.25).of(RUN).outputs == RUN.outputs


def test_without_inputs_nothing_is_enlarged():
    still = Experiment("still", 10.0, 20.0, (), RUN.outputs)
    assert EnlargedCopy(2.0).of(still).key == still.key
