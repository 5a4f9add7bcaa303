import numpy as np
from scipy.signal import lfilter
from support.loop_objects import made_experiments

from cluster_est.statistics.records import StackedRecords, make_records
from workers.messages import FloatArray


def stack(*lengths: int, outputs: int = 1) -> StackedRecords:
    """An experiment for each length, all of its outputs that long."""
    return make_records(made_experiments(*lengths, outputs=outputs))


def coloured(generator: np.random.Generator, count: int, *slopes: float) -> FloatArray:
    """An autoregression, without its start."""
    white = generator.standard_normal(count + 600)
    return np.asarray(lfilter([1.0], [1.0, *(-each for each in slopes)], white)[600:])


def late(signal: FloatArray, lag: float) -> FloatArray:
    """Through a lag of first order, in samples."""
    keep = np.exp(-1.0 / lag)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], signal))


def autoregressive(
    records: StackedRecords, coefficients: FloatArray, generator: np.random.Generator
) -> FloatArray:
    """Stationary noise with innovations of variance 1, independent between records."""
    signals = []
    for item in records.items:
        innovations = generator.standard_normal(len(item.times) + 500)
        signals.append(lfilter([1.0], np.r_[1.0, -coefficients[item.output]], innovations)[500:])
    return np.concatenate(signals)
