"""Charts are HTML with inline SVG that shows what it is given, and escapes what it is told."""

import numpy as np
import pytest
from support.drawn import UNITS, Figures, points
from support.reported import HOSTILE

from cluster_est.report.drawing import (
    Band,
    Bars,
    Cells,
    Chart,
    Dots,
    ErrorBars,
    Line,
    Plot,
    Rules,
    Scale,
)

X = np.linspace(0.0, 1.0, 11)
UNIT = Scale(0.0, 1.0)


def parsed(tmp_path, plot: Plot, **options) -> Figures:
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
