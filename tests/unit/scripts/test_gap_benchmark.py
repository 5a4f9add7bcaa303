import numpy as np
import pytest
from bench_gaps import page, run, write
from gap_benchmark.cases import make_case

import cluster_est as ce

WITH_ROWS_MISSING, WITHOUT_GAPS = 2, 40


def test_a_case_is_the_same_each_time():
    one, other = make_case(WITH_ROWS_MISSING), make_case(WITH_ROWS_MISSING)
    assert one.name == other.name == "002 mass_spring_damper held: cells, rows"
    for a, b in zip(one.records, other.records, strict=True):
        assert np.array_equal(a.outputs, b.outputs, equal_nan=True)


def test_a_gap_has_no_rows_or_no_cells():
    case = make_case(WITH_ROWS_MISSING)
    for record in case.records:
        for first, last, kind in record.gaps:
            inside = (record.times > first) & (record.times < last)
            assert {first, last} <= set(record.times.tolist())
            assert np.isnan(record.outputs[inside]).all()
            assert (kind == "rows") == (not inside.any())


def test_the_model_with_the_true_values_has_the_noise_alone_left(tmp_path):
    case = make_case(WITHOUT_GAPS)
    problem = ce.read_problem(write(case, tmp_path))
    (found, *_) = ce.simulate(problem, values=dict(case.system.parameters)).values()
    errors = found.outcome.residuals
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.15)


def test_a_case_is_checked_and_fitted():
    one = run(make_case(WITH_ROWS_MISSING))
    assert one["told_by_check"] == one["told_by_fit"] == one["gaps"] == 2
    assert max(abs(v) for v in one["off"].values()) < 4.0
    assert "gaps not told of: 0 by check, 0 by fit" in page([one])
