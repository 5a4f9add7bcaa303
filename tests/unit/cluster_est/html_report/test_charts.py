from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.drawn import UNITS, Figures, points
from support.reported import HOSTILE

from cluster_est.html_report.charts import (
    Band,
    Bars,
    Cells,
    Chart,
    Dots,
    ErrorBars,
    Line,
    Plot,
    Rules,
)
from cluster_est.html_report.curve_section import column_of, extremes
from cluster_est.html_report.number_text import (
    beside,
    compact,
    count,
    digits,
    duration,
    interval,
    percent,
)
from cluster_est.html_report.scales import Scale

X = np.linspace(0.0, 1.0, 11)
UNIT = Scale(0.0, 1.0)


def parsed(tmp_path, plot, **options):
    path = tmp_path / "chart.html"
    html = f'<figure id="one">{Chart((plot,), **options).html()}</figure>'
    path.write_text(html, encoding="utf-8")
    return Figures(path)


@pytest.mark.parametrize("kind", [Line, Dots])
def test_a_curve_is_read_back_as_it_was_and_broken_where_a_value_is_missing(tmp_path, kind):
    y = np.where(np.arange(11) == 5, np.nan, np.sin(7.0 * X))
    scale = Scale.around(y)
    found = parsed(tmp_path, Plot("p", "y", UNIT, scale, [kind("c", "after", X, y)]))
    plot = found.by_id("one").plots[0]
    across, up = plot.curve("c")
    assert across == pytest.approx(np.delete(X, 5), abs=plot.grain(plot.x))
    assert up == pytest.approx(np.delete(y, 5), abs=plot.grain(plot.y))
    assert plot.paths["c"][0].count("M") == (2 if kind is Line else 10)


def test_steps_hold_a_value_until_the_next():
    data = Line("c", "after", X[:3], np.array([0.0, 1.0, 0.5]), steps=True).data(UNIT, UNIT)
    across, down = points(data)
    assert across.tolist() == [0, 1000, 1000, 2000, 2000]
    assert (UNITS - down).tolist() == [0, 0, UNITS, UNITS, 5000]


def test_bars_stand_on_the_lower_end_or_on_zero():
    data = Bars("", "faint", np.array([0.0, 0.5, 1.0]), np.array([0.2, 0.0])).data(UNIT, UNIT)
    assert data == f"M0 8000H5000V{UNITS}H0z"
    both = Bars("", "faint", np.array([0.0, 1.0]), np.array([-1.0])).data(UNIT, Scale(-1.0, 1.0))
    assert both == f"M0 {UNITS}H{UNITS}V5000H0z"


def test_cells_have_a_box_for_each_run_of_one_shade():
    shares = np.array([[1.0, 1.0, 0.0, 0.5]])
    mark = Cells("", "after", np.linspace(0.0, 1.0, 5), shares)
    svg = str(mark.svg(UNIT, Scale(0.5, -0.5)))
    assert svg.count("z") == 2
    assert 'level-5" d="M0 ' in svg
    assert f"H{UNITS // 2}" in svg


def test_every_plot_says_what_it_shows_to_those_who_do_not_see_it(tmp_path):
    marks = [
        Band("band", "after", X, X - 0.1, X + 0.1),
        ErrorBars("", "measured", X, X - 0.1, X + 0.1),
        Rules("noise", "faint", x=(0.5,), y=(0.2,)),
    ]
    found = parsed(tmp_path, Plot("what it shows", "y", UNIT, UNIT, marks))
    assert (found.svgs[0]["role"], found.svgs[0]["aria-label"]) == ("img", "what it shows")
    assert found.titles == 1
    assert {"band", "noise"} <= set(found.by_id("one").texts)


def test_texts_of_charts_are_escaped(tmp_path):
    marks = [Dots(HOSTILE, "after", X, X)]
    plot = Plot(HOSTILE, HOSTILE, UNIT, Scale(0.5, -0.5), marks, 40, [HOSTILE])
    html = str(Chart((plot,), HOSTILE).html())
    assert not [tag for tag in ("<img", "<b>", "</script") if tag in html]
    found = parsed(tmp_path, plot, below=HOSTILE)
    assert found.by_id("one").texts.count(HOSTILE) >= 4
    assert found.by_id("one").plots[0].paths.keys() == {HOSTILE}


@pytest.mark.parametrize(("low", "high"), [(0.00168, 0.00218), (0.0, 1.0), (12345.67, 12345.69)])
def test_numbers_below_a_plot_do_not_run_together(low, high):
    plot = Plot("title", "", Scale(low, high), Scale(0.0, 1.0), ())
    texts = [text for _, text in plot.under(10)]
    assert len(texts) >= 1
    assert sum(len(text) + 2 for text in texts) <= 70


FINITE = st.floats(-1e9, 1e9)


@given(st.lists(FINITE, min_size=1, max_size=20))
def test_every_value_stands_inside(values):
    places = Scale.around(np.array(values)).places(np.array(values))
    assert np.all((places >= 0) & (places <= UNITS))


@given(FINITE, st.floats(1e-6, 1e9), st.integers(2, 10))
def test_written_values_are_few_evenly_spaced_and_different(low, span, most):
    scale = Scale(low, low + span)
    if not scale.high - scale.low > 1e-7 * abs(low):
        return
    found = scale.ticks(most)
    values = np.array([value for value, _ in found])
    assert 2 <= len(found) <= max(1.35 * most + 1, 5)  # a step finer, where there was but one
    assert np.all((values >= scale.low - 1e-6 * span) & (values <= scale.high + 1e-6 * span))
    if len(values) > 2:
        assert np.diff(values) == pytest.approx(np.diff(values)[0], rel=1e-3)
    assert len({text for _, text in found}) == len(found)


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0.0, 10.0, "0 2 4 6 8 10"),
        (-0.05, 0.05, "\u22120.04 \u22120.02 0 0.02 0.04"),
        (0.0, 3e6, "0 1e6 2e6 3e6"),
        (1e7, 1e7 + 4.0, "1.0000000e7 1.0000001e7 1.0000002e7 1.0000003e7 1.0000004e7"),
    ],
)
def test_they_are_round_and_have_the_digits_they_need(low, high, texts):
    assert [text for _, text in Scale(low, high).ticks(4)] == texts.split()


def test_a_scale_of_large_ratios_is_logarithmic_where_it_may_be():
    values = np.array([0.001, 50.0])
    scale = Scale.around(values, may_be_log=True)
    assert scale.log
    assert [text for _, text in scale.ticks(6)] == ["0.001", "0.01", "0.1", "1", "10"]
    middle = scale.places(np.sqrt(values[:1] * values[1:]))
    assert middle == pytest.approx([0.5 * UNITS])
    assert np.isnan(scale.places(np.array([-1.0, 0.0]))).all()
    assert not Scale.around(values).log
    assert not Scale.around(np.array([1.0, 9.0]), may_be_log=True).log


def test_values_that_are_equal_or_none_have_a_scale_too():
    for values in (np.full(3, 5.0), np.zeros(2), np.array([np.nan]), np.zeros(0)):
        scale = Scale.around(values)
        assert scale.high > scale.low


@pytest.mark.parametrize("low", [-1.31, -0.99, 0.02, 311.3])
@pytest.mark.parametrize("span", [1e-6, 0.7, 3.21, 4.1, 9.9])
def test_there_are_two_ticks_at_least_so_that_a_size_can_be_read(low, span):
    ticks = [value for value, _ in Scale(low, low + span).ticks(1)]
    assert 2 <= len(ticks) <= 12
    assert all(low <= value <= low + span for value in ticks)


NUMBERS = st.floats(-1e6, 1e6) | st.just(float("nan"))
CURVES = st.integers(1, 400).flatmap(
    lambda size: st.tuples(
        arrays(np.float64, size, elements=st.floats(0.0, 1e4)),
        arrays(np.float64, size, elements=NUMBERS),
    )
)


@given(CURVES, st.integers(4, 40))
def test_the_extremes_of_each_column_are_kept_and_little_else(curve, columns):
    times, y = np.sort(curve[0]), curve[1]
    kept = extremes(times, y, columns)
    gaps = int((np.diff(np.isfinite(y)) != 0).sum())
    assert len(kept) <= 2 * columns + 2 + 2 * gaps
    assert np.all(np.diff(kept) > 0)
    assert (kept[0], kept[-1]) == (0, len(y) - 1)
    place = column_of(times, columns)
    for column in np.unique(place):
        whole, inside = y[place == column], y[kept[place[kept] == column]]
        if np.isfinite(whole).any():
            assert np.nanmin(inside) == np.nanmin(whole)
            assert np.nanmax(inside) == np.nanmax(whole)


def test_columns_are_as_wide_as_each_other_whatever_the_sampling():
    times = np.array([0.0, 0.1, 0.2, 0.3, 9.0, 10.0])
    assert column_of(times, 10).tolist() == [0, 0, 0, 0, 9, 9]


def test_a_gap_stays_a_gap():
    curve = np.ones(10_000)
    curve[4000:4010] = np.nan
    kept = extremes(np.arange(10_000.0), curve, 50)
    assert np.isnan(curve[kept]).any()
    assert {3999, 4000, 4009, 4010} <= set(kept.tolist())


def test_no_samples_have_no_points():
    assert len(extremes(np.zeros(0), np.zeros(0), 10)) == 0


@pytest.mark.parametrize(
    ("write", "value", "text"),
    [
        (digits, 0.0, "0"),
        (digits, None, "\u2013"),
        (digits, nan, "\u2013"),
        (digits, -inf, "\u2212\u221e"),
        (digits, 1234.56, "1235"),
        (digits, -0.00123456, "\u22120.001235"),
        (digits, 1.5e-7, "1.500e\u22127"),
        (digits, 12345678.0, "1.235e7"),
        (digits, 0.99999, "1.0000"),
        (count, 13553, "13\u202f553"),
        (percent, 0.123456, "12.3\u2009%"),
        (percent, 0.99998, "99.998\u2009%"),
        (percent, 1.0, "100\u2009%"),
        (percent, 1.56e-9, "1.56e\u22127\u2009%"),
        (duration, 2.5, "2.50 s"),
        (duration, 75.0, "1 min 15 s"),
        (duration, 7300.0, "2 h 1 min"),
        (compact, 0.001, "0.001"),
        (compact, 10.0, "10"),
        (compact, inf, "\u221e"),
    ],
)
def test_a_number_is_written_so(write, value, text):
    assert write(value) == text


def test_an_estimate_has_two_digits_of_the_width_of_its_interval():
    assert beside(1.19972345, 0.0016) == "1.1997"
    assert beside(25.0, 100.0) == "25.00"
    assert interval(1.19891, 1.20053) == "1.1989 \u2026 1.2005"
    assert interval(nan, 1.0) == "\u2013"
