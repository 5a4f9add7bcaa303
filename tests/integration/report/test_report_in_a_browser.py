"""The report of a run in a headless Chromium: it draws, zooms, switches, and asks nobody."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.reported import chromium, fitted_run

from cluster_est.report import write_report

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@dataclass
class Seen:
    """A page that is open, and what it has said and asked for."""

    page: Any
    said: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Two springs with an output that is seen at 150 times, and a third held out."""
    return fitted_run(tmp_path_factory.mktemp("fit") / "run", experiments=3)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    path = chromium()
    if path is None:
        pytest.skip("needs a Chromium, or its path in CLUSTER_EST_CHROMIUM")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=path, args=FLAGS)
        yield opened
        opened.close()


def opened(browser: Any, file: Path, **options: Any) -> Seen:
    page = browser.new_page(**options)
    seen = Seen(page)
    page.on("console", lambda message: seen.said.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: seen.said.append(str(error)))
    page.on("request", lambda request: seen.asked.append(request.url))
    page.goto(file.as_uri())
    return seen


@pytest.fixture
def seen(browser, run) -> Iterator[Seen]:
    found = opened(browser, write_report(run), viewport={"width": 1440, "height": 900})
    found.page.locator("#curves-plot").scroll_into_view_if_needed()
    found.page.wait_for_selector("#curves-plot .scatterlayer .trace")
    yield found
    found.page.close()


def lines(page: Any) -> int:
    """How many curves are drawn."""
    return int(page.locator("#curves-plot .scatterlayer .trace").count())


def until_lines(page: Any, count: int) -> None:
    """Wait until so many are; as a function, because the page's policy lets no text be run."""
    traces = "document.querySelectorAll('#curves-plot .scatterlayer .trace')"
    page.wait_for_function(f"() => {traces}.length == {count}")


def axis(page: Any, name: str) -> list[float]:
    found: list[float] = page.evaluate(
        f"document.getElementById('curves-plot')._fullLayout.{name}.range"
    )
    return found


def measured(page: Any) -> list[float]:
    found: list[float] = page.evaluate(
        "Array.from(document.getElementById('curves-plot').data[0].y)"
    )
    return found


def test_every_plot_is_drawn_and_nobody_is_asked(seen, run):
    page = seen.page
    for place in page.locator(".plot").all():
        place.scroll_into_view_if_needed()
        place.locator(".main-svg").first.wait_for()
    assert seen.said == []
    assert seen.asked == [(run / "report.html").as_uri()]
    assert page.evaluate("document.documentElement.scrollWidth") <= 1440
    paints = page.evaluate("performance.getEntriesByType('paint').length")
    assert paints > 0


def test_dragging_zooms_and_a_double_click_shows_all_again(seen):
    page = seen.page
    before = axis(page, "xaxis")
    box = page.locator("#curves-plot .nsewdrag").first.bounding_box()
    x, y, width, height = box["x"], box["y"], box["width"], box["height"]
    page.mouse.move(x + 0.3 * width, y + 0.3 * height)
    page.mouse.down()
    page.mouse.move(x + 0.6 * width, y + 0.7 * height, steps=5)
    page.mouse.up()
    page.wait_for_function(
        "([a, b]) => { const r = document.getElementById('curves-plot')._fullLayout.xaxis.range;"
        " return r[1] - r[0] < 0.5 * (b - a); }",
        arg=before,
    )
    low, high = axis(page, "xaxis")
    span = before[1] - before[0]
    assert low == pytest.approx(before[0] + 0.3 * span, abs=0.02 * span)
    assert high == pytest.approx(before[0] + 0.6 * span, abs=0.02 * span)
    page.mouse.dblclick(x + 0.5 * width, y + 0.5 * height)
    page.wait_for_function(
        "([a, b]) => { const r = document.getElementById('curves-plot')._fullLayout.xaxis.range;"
        " return Math.abs(r[0] - a) < 1e-6 && Math.abs(r[1] - b) < 1e-6; }",
        arg=before,
    )
    assert seen.said == []


def test_curves_are_toggled(seen):
    page = seen.page
    assert lines(page) == 5  # measured, and before and after with their residuals
    page.locator("input[name=before]").uncheck()
    until_lines(page, 3)
    page.locator("input[name=after]").uncheck()
    until_lines(page, 1)
    page.locator("input[name=before]").check()
    until_lines(page, 3)
    assert seen.said == []


def test_another_experiment_shows_its_own_curves(seen, run):
    page = seen.page
    table = pq.read_table(run / "residuals.parquet").to_pandas()
    options = page.locator("select[name=experiment] option").all_text_contents()
    assert options == ["e0", "e1", "e2 (held out)"]
    for number, name in enumerate(["e0", "e1", "e2"]):
        page.locator("select[name=experiment]").select_option(str(number))
        until_lines(page, 5)
        own = table[table.experiment == name].measured.to_numpy()
        assert measured(page) == pytest.approx(own, abs=1e-7)
    assert page.locator("select[name=output]").is_hidden()
    assert seen.said == []


def test_it_fits_a_phone_and_follows_dark_mode(browser, run):
    phone = {"viewport": {"width": 390, "height": 844}}
    seen = opened(browser, write_report(run), color_scheme="dark", **phone)
    page = seen.page
    colour = "getComputedStyle(document.documentElement).getPropertyValue('--page')"
    dark = page.evaluate(colour)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.locator("#curves-plot").scroll_into_view_if_needed()
    page.wait_for_selector("#curves-plot .scatterlayer .trace")
    paper = "document.getElementById('curves-plot')._fullLayout.paper_bgcolor"
    assert page.evaluate(paper) == dark.strip()
    page.emulate_media(color_scheme="light")
    page.wait_for_function(f"() => {paper} != '{dark.strip()}'")
    assert seen.said == []
    page.close()


def test_on_paper_every_plot_is_drawn_and_none_is_wider_than_the_page(browser, run, tmp_path):
    seen = opened(browser, write_report(run), viewport={"width": 1440, "height": 900})
    page = seen.page
    page.emulate_media(media="print")
    widths = "[...document.querySelectorAll('.plot')].map((each) => each._fullLayout?.width)"
    page.wait_for_function(f"() => {widths}.every((width) => width === 660)")
    assert len(page.pdf(format="A4", path=tmp_path / "report.pdf")) > 10_000
    assert seen.said == []
    page.close()
