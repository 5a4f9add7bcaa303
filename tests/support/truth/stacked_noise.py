"""Records and noise for the tests of the statistics."""

import numpy as np
from scipy.signal import lfilter

from cluster_est.statistics.records import StackedRecords, make_records
from workers.messages import Experiment, FloatArray, Output


def stack(*lengths: int, outputs: int = 1) -> StackedRecords:
    """An experiment for each length, all of its outputs that long."""
    return make_records(
        [
            Experiment(
                f"e{e}",
                0.0,
                1.0,
                (),
                tuple(
                    Output(f"y{i}", np.linspace(0.0, 1.0, n), np.zeros(n)) for i in range(outputs)
                ),
            )
            for e, n in enumerate(lengths)
        ]
    )


def autoregressive(
    records: StackedRecords, coefficients: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Stationary noise with innovations of variance 1, independent between records."""
    signals = []
    for item in records.items:
        innovations = generator.standard_normal(len(item.times) + 500)
        signals.append(lfilter([1.0], np.r_[1.0, -coefficients[item.output]], innovations)[500:])
    return np.concatenate(signals)
