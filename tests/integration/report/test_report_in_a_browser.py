from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pyarrow as pa
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
    found.locator("#worst").scroll_into_view_if_needed()
    return found


def view(page):
    """The times between which the large chart shows its curves; none where it shows all."""
    text = page.locator("#worst .chart").get_attribute("data-view")
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
    plot = page.locator("#worst .plot").nth(1)
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
    texts = page.locator("#worst .x-axis span").all_text_contents()
    assert all(low <= float(text) <= high for text in texts)
    assert len(texts) >= 3
    page.mouse.dblclick(x + 0.5 * width, y + 0.5 * height)
    assert view(page) == []
    assert plot.locator("svg").get_attribute("viewBox") == whole


@pytest.mark.slow
def test_values_are_shown_under_the_pointer(page, run):
    caption = page.locator("#worst figcaption").text_content()
    name = caption.partition(": ")[2].partition(",")[0]
    table = pq.read_table(run / "residuals.parquet").to_pandas()
    own = table[table.experiment == name]
    box = page.locator("#worst .plot").nth(1).bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    lines = page.locator("#worst .tip div").all_text_contents()
    assert len(lines) == 6  # the time, the input, three curves and what is left
    shown = {line.rsplit(" ", 1)[0]: line.rsplit(" ", 1)[1] for line in lines}
    measured = float(shown["measured"].replace("\u2212", "-"))
    middle = 0.5 * (own.time.min() + own.time.max())
    row = own.iloc[(own.time - middle).abs().argmin()]
    assert measured == pytest.approx(row.measured, abs=5e-3 * np.ptp(own.measured))
    page.mouse.move(5, 5)
    assert page.locator("#worst .tip").is_hidden()


@pytest.mark.slow
def test_curves_are_toggled(page):
    assert (visible(page, "before"), visible(page, "after")) == (3, 6)
    page.locator("input[name=before]").uncheck()
    assert (visible(page, "before"), visible(page, "after")) == (0, 6)
    page.locator("input[name=after]").uncheck()
    assert (visible(page, "before"), visible(page, "after")) == (0, 0)
    page.locator("input[name=before]").check()
    assert (visible(page, "before"), visible(page, "after")) == (3, 0)


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
    small = page.locator(".panel").first
    name = small.get_attribute("data-experiment")
    panel = page.locator(f".panel[data-experiment={name}]")
    before = panel.bounding_box()
    panel.locator("button.size").click()
    after = panel.bounding_box()
    assert after["width"] > 2 * before["width"]
    assert after["height"] > before["height"]
    panel.locator("button.size").click()
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
    assert page.locator("button").count() == 3  # those that make a panel larger
    assert page.locator(".panel button").first.is_hidden()


def test_the_first_screen_has_the_answer(page):
    """Its words, the parameters and both pictures begin on it, on a laptop's screen."""
    page.evaluate("scrollTo(0, 0)")
    for name in ("h1", ".summary", ".answer table >> nth=0", ".answer table >> nth=1", ".next"):
        box = page.locator(name).bounding_box()
        assert box["y"] + box["height"] < 900
    for name in ("#worst", "#held-out"):
        box = page.locator(f"{name} .plot").last.bounding_box()
        assert box["y"] + box["height"] < 900


def saved(page, figure, kind, path):
    """Save a picture of the page."""
    page.locator(figure).hover()
    with page.expect_download() as download:
        page.locator(f"{figure} .tools button", has_text=kind).click()
    download.value.save_as(path)
    return download.value.suggested_filename


@pytest.mark.slow
def test_each_picture_is_saved_as_a_drawing_as_pixels_and_as_numbers(page, run, tmp_path):
    for kind in ("SVG", "PNG", "CSV"):
        assert saved(page, "#worst", kind, tmp_path / kind) == f"worst.{kind.lower()}"
    drawing = ElementTree.parse(tmp_path / "SVG").getroot()
    words = [each.text for each in drawing.iter("{http://www.w3.org/2000/svg}text")]
    assert "time (s)" in words
    assert {"measured", "before", "after"} <= set(words)
    plots = drawing.findall("{http://www.w3.org/2000/svg}svg")
    assert len(plots) == 3
    assert all(plot.findall("{http://www.w3.org/2000/svg}path") for plot in plots)
    assert (tmp_path / "PNG").read_bytes().startswith(b"\x89PNG")
    table = pd.read_csv(tmp_path / "CSV")
    caption = page.locator("#worst figcaption").text_content()
    name = caption.partition(": ")[2].partition(",")[0]
    every = pq.read_table(run / "residuals.parquet").to_pandas()
    own = every[every.experiment == name]
    shown = table[(table.curve == "measured")].sort_values("time (s)")
    span = np.ptp(own.measured)
    assert shown.value.to_numpy() == pytest.approx(own.measured.to_numpy(), abs=1e-3 * span)


@pytest.mark.slow
def test_zooming_in_draws_every_sample_of_a_long_record(browser, copied, tmp_path):
    times = np.arange(20_000) * 1e-3
    measured = np.random.default_rng(0).normal(size=len(times))
    columns = {"experiment": "long", "role": "train", "output": "y"}
    columns = {key: np.full(len(times), text) for key, text in columns.items()}
    columns |= {"time": times, "measured": measured, "simulated": np.zeros(len(times))}
    columns |= {"residual": measured, "simulated_before": np.ones(len(times))}
    pq.write_table(pa.table(columns), copied / "residuals.parquet")
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(write_report(copied).as_uri())
    plot = page.locator("#worst .plot").first
    path = plot.locator("path.measured")
    whole, box = path.get_attribute("d"), plot.bounding_box()
    page.mouse.move(box["x"] + 0.50 * box["width"], box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.53 * box["width"], box["y"] + 60, steps=4)
    page.mouse.up()
    low, high = view(page)
    inside = int(((times >= low) & (times <= high)).sum())
    assert 400 < inside < 800
    assert abs(path.get_attribute("d").count("L") + 1 - inside) <= 3
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 30)
    lines = page.locator("#worst .tip div").all_text_contents()
    at = float(lines[0].rsplit(" ", 1)[1])
    near = measured[np.abs(times - at) < 2e-3]
    shown = dict(line.rsplit(" ", 1) for line in lines)
    value = float(shown["measured"].replace("\u2212", "-"))
    assert np.abs(near - value).min() < 0.02
    assert shown["after, residual"] == shown["measured"]
    page.mouse.dblclick(box["x"] + 0.5 * box["width"], box["y"] + 20)
    assert path.get_attribute("d") == whole
    saved(page, "#worst", "CSV", tmp_path / "all.csv")
    table = pd.read_csv(tmp_path / "all.csv")
    assert table["measured"].to_numpy() == pytest.approx(measured, rel=1e-6)
    page.close()


@pytest.mark.slow
def test_on_paper_no_chart_is_wider_than_the_page(opened, tmp_path):
    page = opened(viewport={"width": 700, "height": 900})
    page.emulate_media(media="print")
    for chart in page.locator(".chart").all():
        box = chart.bounding_box()
        assert box["x"] + box["width"] <= 701
    assert page.locator(".panel button").first.is_hidden()
    assert len(page.pdf(format="A4", path=tmp_path / "report.pdf")) > 10_000
