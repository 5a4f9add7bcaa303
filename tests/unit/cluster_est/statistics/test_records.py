"""Rows of the stacked residual vector, and thinning it."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cluster_est.statistics.records import make_records, thinned
from workers.messages import Experiment, Output


def run(name: str, *outputs: tuple[str, int]) -> Experiment:
    signals = tuple(Output(v, np.linspace(0.0, 1.0, n), np.zeros(n)) for v, n in outputs)
    return Experiment(name, 0.0, 1.0, (), signals)


RUNS = [run("a", ("x", 4), ("y", 3)), run("b", ("y", 2)), run("c", ("y", 1), ("z", 5))]


def test_rows_follow_the_stacking() -> None:
    records = make_records(RUNS)
    assert records.outputs == ("x", "y", "z")
    assert records.size == 15
    assert [(r.experiment, r.output) for r in records.items] == [
        (0, 0),
        (0, 1),
        (1, 1),
        (2, 1),
        (2, 2),
    ]
    assert records.of_output(1).tolist() == [4, 5, 6, 7, 8, 9]
    assert records.of_experiment(2).tolist() == [9, 10, 11, 12, 13, 14]
    assert records.of_experiment(7).tolist() == []
    assert make_records([]).size == 0


@given(st.lists(st.integers(0, 40), min_size=1, max_size=6), st.integers(1, 100))
def test_thinning_keeps_every_sth_sample_of_each_record(lengths: list[int], most: int) -> None:
    records = make_records([run(str(i), ("y", n)) for i, n in enumerate(lengths)])
    fewer, rows = thinned(records, most)
    times = np.concatenate([item.times for item in records.items])
    assert np.concatenate([item.times for item in fewer.items]).tolist() == times[rows].tolist()
    assert fewer.size == len(rows) == sum(len(item.times) for item in fewer.items)
    assert fewer.size <= max(most, len(lengths))
    assert fewer.size == records.size or records.size > most
    strides = set()
    for old, new in zip(records.items, fewer.items, strict=True):
        assert (old.experiment, old.output) == (new.experiment, new.output)
        kept = rows[new.rows]
        assert kept.tolist() == [] or kept[0] == old.rows.start
        strides.update(np.diff(kept).tolist())
    assert len(strides) <= 1
