from itertools import pairwise

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.reported import chromium

from cluster_est.html_report.page import write_report

FLAGS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]


@pytest.fixture(scope="module")
def browser():
    path = chromium()
    if path is None:
        pytest.skip("needs a Chromium, or its path in CLUSTER_EST_CHROMIUM")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=path, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture
def opened(browser, run):
    """Opens the report, which says nothing in the console and asks nobody for anything."""
    address, pages = write_report(run).as_uri(), []
    said: list[str] = []
    asked: list[str] = []

    def call(**options):
        page = browser.new_page(**options)
        page.on("console", lambda message: said.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(address)
        pages.append(page)
        return page

    yield call
    assert said == []
    assert asked == [address] * len(pages)
    for page in pages:
        page.close()


@pytest.fixture
def page(opened):
    found = opened(viewport={"width": 1440, "height": 900})
    found.locator(".panel.wide").scroll_into_view_if_needed()
    return found


def view(page):
    """The times between which the large chart shows its curves; none where it shows all."""
    text = page.locator(".panel.wide .chart").get_attribute("data-view")
    return [float(number) for number in (text or "").split()]


def visible(page, ink):
    """How many curves of one kind are seen."""
    return sum(path.is_visible() for path in page.locator(f".panel path.{ink}").all())


def test_everything_is_drawn_and_nobody_is_asked(page):
    for place in page.locator(".plot").all():
        box = place.bounding_box()
        assert box["width"] > 100
        assert place.locator("svg").bounding_box() == pytest.approx(box)
    assert page.evaluate("document.documentElement.scrollWidth") <= 1440


@pytest.mark.slow
def test_what_is_written_beside_the_plots_does_not_overlap(page):
    for kind, place, size in ((".x-axis", "x", "width"), (".y-axis", "y", "height")):
        for axis in page.locator(kind).all():
            boxes = sorted((t.bounding_box() for t in axis.locator("span").all()),
                           key=lambda box: box[place])  # fmt: skip
            for first, second in pairwise(boxes):
                assert first[place] + first[size] <= second[place] + 1.0


@pytest.mark.slow
def test_dragging_zooms_and_a_double_click_shows_all_again(page, run):
    plot = page.locator(".panel.wide .plot").first
    whole = plot.locator("svg").get_attribute("viewBox")
    box = plot.bounding_box()
    x, y, width, height = box["x"], box["y"], box["width"], box["height"]
    assert view(page) == []
    page.mouse.move(x + 0.3 * width, y + 0.3 * height)
    page.mouse.down()
    page.mouse.move(x + 0.6 * width, y + 0.7 * height, steps=5)
    page.mouse.up()
    low, high = view(page)
    end = float(pq.read_table(run / "trajectories.parquet").to_pandas().time.max())
    assert low == pytest.approx(0.3 * end, abs=0.02 * end)
    assert high == pytest.approx(0.6 * end, abs=0.02 * end)
    texts = page.locator(".panel.wide .x-axis span").all_text_contents()
    assert all(low <= float(text) <= high for text in texts)
    assert len(texts) >= 3
    page.mouse.dblclick(x + 0.5 * width, y + 0.5 * height)
    assert view(page) == []
    assert plot.locator("svg").get_attribute("viewBox") == whole


@pytest.mark.slow
def test_values_are_shown_under_the_pointer(page, run):
    name = page.locator(".panel.wide").get_attribute("data-experiment")
    table = pq.read_table(run / "residuals.parquet").to_pandas()
    own = table[table.experiment == name]
    box = page.locator(".panel.wide .plot").first.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    lines = page.locator(".panel.wide .tip div").all_text_contents()
    assert len(lines) == 6  # the time, three curves and two residuals
    shown = {line.rsplit(" ", 1)[0]: line.rsplit(" ", 1)[1] for line in lines}
    measured = float(shown["measured"].replace("\u2212", "-"))
    middle = 0.5 * (own.time.min() + own.time.max())
    row = own.iloc[(own.time - middle).abs().argmin()]
    assert measured == pytest.approx(row.measured, abs=5e-3 * np.ptp(own.measured))
    page.mouse.move(5, 5)
    assert page.locator(".panel.wide .tip").is_hidden()


@pytest.mark.slow
def test_curves_are_toggled(page):
    assert (visible(page, "before"), visible(page, "after")) == (6, 6)
    page.locator("input[name=before]").uncheck()
    assert (visible(page, "before"), visible(page, "after")) == (0, 6)
    page.locator("input[name=after]").uncheck()
    assert (visible(page, "before"), visible(page, "after")) == (0, 0)
    page.locator("input[name=before]").check()
    assert (visible(page, "before"), visible(page, "after")) == (6, 0)


@pytest.mark.slow
def test_another_experiment_is_shown_in_large(page):
    options = page.locator("select[name=experiment] option").all_text_contents()
    assert options == ["all", "e0", "e1", "e2"]
    for name in ["e0", "e1", "e2"]:
        page.locator("select[name=experiment]").select_option(name)
        seen_now = [p for p in page.locator(".panel").all() if p.is_visible()]
        assert [p.get_attribute("data-experiment") for p in seen_now] == [name]
        assert seen_now[0].bounding_box()["width"] > 900
    page.locator("select[name=experiment]").select_option("")
    assert sum(p.is_visible() for p in page.locator(".panel").all()) == 3


@pytest.mark.slow
def test_a_small_chart_is_enlarged_and_made_small_again(page):
    small = page.locator(".panel:not(.wide)").first
    name = small.get_attribute("data-experiment")
    panel = page.locator(f".panel[data-experiment={name}]")
    before = panel.bounding_box()
    panel.locator("button").click()
    after = panel.bounding_box()
    assert after["width"] > 2 * before["width"]
    assert after["height"] > before["height"]
    panel.locator("button").click()
    assert panel.bounding_box()["width"] == pytest.approx(before["width"])


@pytest.mark.slow
def test_it_fits_a_phone_and_follows_dark_mode(opened):
    page = opened(color_scheme="dark", viewport={"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    colour = "getComputedStyle(document.body).backgroundColor"
    ink = "getComputedStyle(document.querySelector('.panel path.after')).stroke"
    dark = page.evaluate(f"[{colour}, {ink}]")
    page.emulate_media(color_scheme="light")
    light = page.evaluate(f"[{colour}, {ink}]")
    assert dark[0] != light[0]
    assert dark[1] != light[1]


@pytest.mark.slow
def test_it_is_whole_without_scripts(opened):
    page = opened(java_script_enabled=False)
    assert page.locator(".panel path.after").count() == 6
    assert all(path.is_visible() for path in page.locator(".panel path.after").all())
    assert page.locator(".panel button").first.is_hidden()


@pytest.mark.slow
def test_on_paper_no_chart_is_wider_than_the_page(opened, tmp_path):
    page = opened(viewport={"width": 700, "height": 900})
    page.emulate_media(media="print")
    for chart in page.locator(".chart").all():
        box = chart.bounding_box()
        assert box["x"] + box["width"] <= 701
    assert page.locator(".panel button").first.is_hidden()
    assert len(page.pdf(format="A4", path=tmp_path / "report.pdf")) > 10_000
