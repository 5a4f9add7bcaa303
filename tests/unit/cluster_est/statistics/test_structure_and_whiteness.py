import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.truth.stacked_noise import stack

from cluster_est.statistics.projection import OrthogonalProjection, ProjectedResidual
from cluster_est.statistics.records import StackedRecords, make_records, thinned
from cluster_est.statistics.residual_tests import FAMILY_WISE_LEVEL, structure
from cluster_est.statistics.whiteness import (
    SmoothedColumns,
    StructureKernel,
    WhiteNull,
    smoothness,
    traces,
)
from workers.messages import Experiment, FloatArray, Output

RECORDS = stack(150, 100, 3, 1)
TREND = np.concatenate([item.times for item in RECORDS.items])
SENSITIVITIES = np.column_stack([np.ones(RECORDS.size), TREND])


def p_of(residuals: FloatArray, records: StackedRecords, *sensitivities: FloatArray) -> float:
    matrix = np.column_stack(sensitivities or [np.zeros((records.size, 0))])
    return structure(ProjectedResidual(OrthogonalProjection(matrix), residuals), records).p


def test_the_level_is_kept_under_the_null() -> None:
    generator = np.random.default_rng(20)
    draws = [generator.standard_normal(RECORDS.size) for _ in range(400)]
    p = np.array([p_of(noise, RECORDS, SENSITIVITIES) for noise in draws])
    assert 0.01 <= float((p < 0.05).mean()) <= 0.08
    assert np.sum(p < FAMILY_WISE_LEVEL) <= 4


def test_what_the_parameters_explain_is_no_structure() -> None:
    noise = np.random.default_rng(22).standard_normal(RECORDS.size)
    shifted = noise + SENSITIVITIES @ np.array([50.0, -80.0])
    alone = p_of(noise, RECORDS, SENSITIVITIES)
    assert p_of(-1e6 * shifted, RECORDS, SENSITIVITIES) == pytest.approx(alone, rel=1e-6)
    assert p_of(np.zeros(RECORDS.size), RECORDS, SENSITIVITIES) == 1.0
    assert p_of(SENSITIVITIES @ np.ones(2), RECORDS, SENSITIVITIES) == 1.0


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_structure_in_one_of_many_outputs_is_seen_whatever_its_scale(scale: float) -> None:
    records = stack(60, 60, 60, outputs=12)
    rows = records.of_output(7)
    wave = np.sin(2.0 * np.pi * np.arange(len(rows)) / 30.0)
    for seed in range(5):  # among the noise of all 12, the wave is missed in some of these
        residuals = np.random.default_rng(seed).standard_normal(records.size)
        residuals[rows] = scale * (residuals[rows] + wave)
        assert p_of(residuals, records) <= FAMILY_WISE_LEVEL


def test_an_output_of_which_nothing_is_left_is_no_structure() -> None:
    records = stack(80, 80, outputs=2)
    residuals = np.random.default_rng(26).standard_normal(records.size)
    residuals[records.of_output(0)] = 0.0
    assert p_of(residuals, records) > FAMILY_WISE_LEVEL


def run(name: str, *outputs: tuple[str, int]) -> Experiment:
    signals = tuple(Output(v, np.linspace(0.0, 1.0, n), np.zeros(n)) for v, n in outputs)
    return Experiment(name, 0.0, 1.0, (), signals)


RUNS = [run("a", ("x", 4), ("y", 3)), run("b", ("y", 2)), run("c", ("y", 1), ("z", 5))]


def test_rows_follow_the_stacking() -> None:
    records = make_records(RUNS)
    assert records.outputs == ("x", "y", "z")
    assert records.size == 15
    found = [(item.experiment, item.output) for item in records.items]
    assert found == [(0, 0), (0, 1), (1, 1), (2, 1), (2, 2)]
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


OF_TWO_OUTPUTS = stack(150, 100, outputs=2)
KERNELS = [StructureKernel(1.0), StructureKernel(6.0), StructureKernel(5.0, 0.7)]


def null(noise: float = 1.0) -> WhiteNull:
    """A fit of an offset and a slope to both outputs, of which the second is louder."""
    times = np.concatenate([item.times for item in OF_TWO_OUTPUTS.items])
    levels = np.ones(OF_TWO_OUTPUTS.size)
    levels[OF_TWO_OUTPUTS.of_output(1)] = noise
    return WhiteNull(OrthogonalProjection(np.column_stack([times**0, times])).basis, levels)


def matrix(kernel: StructureKernel, rows: np.ndarray) -> np.ndarray:
    """K of the records in these rows, entry by entry."""
    result = np.zeros((OF_TWO_OUTPUTS.size, OF_TWO_OUTPUTS.size))
    for item in OF_TWO_OUTPUTS.items:
        own = np.arange(item.rows.start, item.rows.stop)
        lags = own[:, None] - own
        values = np.exp(-0.5 * (lags / kernel.length) ** 2) * np.cos(kernel.frequency * lags)
        if np.isin(own, rows).all():
            result[np.ix_(own, own)] = np.where(np.abs(lags) <= kernel.reach(len(own)), values, 0.0)
    return result


@pytest.mark.parametrize("kernel", KERNELS)
def test_cumulants_are_those_of_the_whole_quadratic_form(kernel):
    made, rows, q = null(noise=5.0), OF_TWO_OUTPUTS.of_output(1), 1.3
    form = matrix(kernel, rows)
    form[rows, rows] -= q
    fit = np.eye(OF_TWO_OUTPUTS.size) - (made.basis / made.noise[:, None]) @ (
        (made.basis * made.noise[:, None]).T
    )
    whole = fit.T @ form @ fit
    powers = [np.trace(np.linalg.matrix_power(whole, m)) for m in (1, 2, 3)]
    smooth = SmoothedColumns.of(np.ones(OF_TWO_OUTPUTS.size), made, OF_TWO_OUTPUTS.items, kernel)
    group = [item for item in OF_TWO_OUTPUTS.items if item.output == 1]
    own = traces(kernel, [len(item.times) for item in group], q)
    found = smooth.cumulants(rows, q, own)
    assert found == pytest.approx((powers[0], 2.0 * powers[1], 8.0 * powers[2]))


def test_what_a_loud_output_puts_into_a_quiet_one_is_no_structure():
    """The slope of both follows the loud one, and the quiet one is left with a ramp."""
    generator = np.random.default_rng(2)
    right, wrong = null(noise=100.0), null()
    quiet = [item for item in OF_TWO_OUTPUTS.items if item.output == 0]
    found = []
    for _ in range(30):
        residuals = OrthogonalProjection(right.basis).remove(
            right.noise * generator.normal(size=OF_TWO_OUTPUTS.size)
        )
        scaled = residuals / right.noise
        found.append([smoothness(scaled, [quiet], each)[0].p for each in (right, wrong)])
    p = np.array(found)
    assert np.sum(p[:, 0] < 1e-3) == 0
    assert np.mean(p[:, 1] < 1e-3) > 0.8


@pytest.mark.parametrize(
    ("period", "size"), [(300.0, 0.45), (60.0, 0.45), (31.0, 0.45), (12.0, 0.6)]
)
def test_structure_of_any_length_is_seen(period, size):
    records = stack(500, 500)
    times = np.tile(np.arange(500.0), 2)
    made = WhiteNull(np.zeros((1000, 0)), np.ones(1000))
    noise = np.random.default_rng(3).normal(size=1000)
    wave = size * np.sin(2.0 * np.pi * times / period)
    structured, white = (smoothness(r, [records.items], made)[0] for r in (noise + wave, noise))
    assert structured.p < 1e-6
    assert white.p > 0.05


def test_there_may_be_nothing_to_test():
    made = null()
    zero, none, one = stack(30), stack(0), stack(1)
    empty = WhiteNull(np.zeros((30, 0)), np.ones(30))
    assert smoothness(np.zeros(30), [zero.items], empty)[0].p == 1.0
    assert smoothness(np.zeros(OF_TWO_OUTPUTS.size), [], made) == []
    for records in (none, one):
        nothing = WhiteNull(np.zeros((records.size, 0)), np.ones(records.size))
        assert smoothness(np.ones(records.size), [records.items], nothing)[0].p == 1.0
