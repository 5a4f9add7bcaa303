"""Windows of a record that are held out: they become a test experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cluster_est.errors import DataError
from workers.messages import Experiment, FloatArray, Output
from workers.messages.checks import is_number

HELD_OUT_SUFFIX = " (held out)"


def hold_out(
    experiment: Experiment, windows: Sequence[tuple[float, float]]
) -> tuple[Experiment, Experiment]:
    """Split a record into a training experiment and a test experiment.

    This is useful if there is one long record instead of several experiments. Both parts are
    simulated from the record's start with the same inputs. Values that are estimated per experiment
    (`x0[run1]`) are estimated from the training part for both parts. The same holds for free
    scales, free offsets and bounds of categories. A window at the end of the record is predicted
    from past data only, and the training part is not simulated beyond its last measured value. A
    window in the middle has data on both sides, so its prediction is easier.

    Parameters
    ----------
    experiment
        A training experiment.
    windows
        Pairs (from, to) in seconds. Values measured in this interval (with its ends) are held out.

    Returns
    -------
    train, test
        "run1" and "run1 (held out)". Curve, bounds and constraints refer to the whole record, so
        they stay with the first.

    Raises
    ------
    DataError
        If it is not a training experiment, a window is invalid, or a part has no measured values.
    """
    where = f"experiment {experiment.id!r}.test_windows"
    _check_windows(windows, where)
    if experiment.role != "train":
        raise DataError(
            f"{where}: must belong to a training experiment, but the role of this experiment is "
            '"test", so all of it is held out already; remove one of the two'
        )
    inside = [within(output.times, windows) for output in experiment.outputs]
    train = replace(experiment, outputs=_kept(experiment.outputs, [~each for each in inside]))
    test = replace(
        experiment,
        id=experiment.id + HELD_OUT_SUFFIX,
        role="test",
        record=experiment.record_id,
        outputs=_learning(_kept(experiment.outputs, inside), train.outputs),
        curve=None,
        bounds=(),
        constraint_functions=(),
    )
    for part, lacks in ((train, "outside the windows"), (test, "within the windows")):
        if not any(len(output.times) for output in part.outputs):
            raise DataError(
                f"{where}: must leave at least one measured value {lacks}, but there is none "
                f"between {experiment.start:g} and {experiment.stop:g} s; change the windows"
            )
    return _no_longer_than_measured(train), test


def _check_windows(windows: Sequence[tuple[float, float]], where: str) -> None:
    pairs = isinstance(windows, Sequence) and all(
        isinstance(w, Sequence) and len(w) == 2 and all(map(is_number, w)) for w in windows
    )
    if not (pairs and windows and all(first <= last for first, last in windows)):
        raise DataError(
            f"{where}: must be a list of [from, to] in seconds, with from before to, but is "
            f"{windows!r}; write [[60.0, 80.0]]"
        )


def within(times: FloatArray, windows: Sequence[tuple[float, float]]) -> npt.NDArray[np.bool_]:
    """Return a mask of the times that lie in one of the windows, including the ends."""
    inside = np.zeros(len(times), dtype=bool)
    for first, last in windows:
        inside |= (times >= first) & (times <= last)
    return inside


def _kept(outputs: Sequence[Output], kept: Sequence[npt.NDArray[np.bool_]]) -> tuple[Output, ...]:
    return tuple(output.only(keep) for output, keep in zip(outputs, kept, strict=True))


def _learning(held_out: Sequence[Output], train: Sequence[Output]) -> tuple[Output, ...]:
    """Return held-out outputs with references to the training data, such as for free scales."""
    return tuple(
        replace(own, reference=before) if own.learns and len(before.times) else own
        for own, before in zip(held_out, train, strict=True)
    )


def _no_longer_than_measured(train: Experiment) -> Experiment:
    """End the training simulation at the last measured value, unless a later part is needed."""
    further = train.curve, train.cost_function, *train.bounds, *train.constraint_functions
    if any(each is not None for each in further):
        return train
    last = max(float(output.times[-1]) for output in train.outputs if len(output.times))
    return replace(train, stop=last) if train.start < last < train.stop else train
