import re
import warnings
from collections.abc import Callable
from functools import cache
from html import unescape
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from docs.pages import (
    SITES,
    Config,
    LimitsSections,
    SweepSections,
    forms_page,
    keys_page,
)
from pydantic import BaseModel
from support.problems.springs import ROOT
from support.reported import chromium

from cluster_est.cli import main
from cluster_est.cli.forms_command import EVERY_FORM
from cluster_est.run_folder.log_segment import read_log
from cluster_est.settings import keys_of
from cluster_est.toml import to_toml

FETCHED = re.compile(r"""(?:<(?:script|img|iframe)[^>]*\ssrc|<link[^>]*\shref)=["']?(https?:)?//""")
SPRING = ROOT / "configs" / "models" / "mass_spring_damper.fmu"
DATA = ROOT / "configs" / "data" / "mass_spring_damper"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The built site; a warning of the build is an error."""
    folder = tmp_path_factory.mktemp("site")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of mkdocs and its parts
        from mkdocs.commands.build import build
        from mkdocs.config import load_config

        config = load_config(
            str(ROOT / "scripts" / "docs" / "mkdocs.yml"), site_dir=str(folder), strict=True
        )
        config.plugins.on_startup(command="build", dirty=False)
        build(config)
    return folder


@pytest.mark.slow
def test_the_site_has_every_page_and_asks_no_other_host_for_anything(site):
    sources = {path.stem for path in (ROOT / "cluster_est" / "docs").glob("*.md")}
    built = {path.stem for path in site.glob("*.html")}
    assert sources | {"keys", "tables", "forms", "commands", "python"} <= built
    pages = [path.read_text(encoding="utf-8") for path in site.glob("*.html")]
    assert [found for page in pages for found in FETCHED.findall(page)] == []
    styles = [path.read_text(encoding="utf-8") for path in site.rglob("*.css")]
    assert styles
    assert [s for s in styles if re.search(r"url\(\s*[\"']?(https?:)?//|@import", s)] == []
    page = (site / "python.html").read_text(encoding="utf-8")  # in the words of the docstrings
    assert "Estimate all parameters of a problem jointly from its training experiments" in page
    assert "Return the residuals of the training experiments as a function" in page


@pytest.mark.slow
def test_the_search_works_when_the_site_is_opened_from_its_folder(site):
    path = chromium()
    if path is None:
        pytest.skip("needs a Chromium, or its path in CLUSTER_EST_CHROMIUM")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page()
        said: list[str] = []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto((site / "index.html").as_uri())
        page.locator("input[name=query]").press_sequentially("multiple shooting")
        page.wait_for_selector(".md-search-result__link", state="attached")
        links = page.locator(".md-search-result__link")
        found = [link.get_attribute("href") for link in links.all()]
        browser.close()
    assert (site / "multiple_shooting.html").as_uri() in found
    assert said == []


def keys(section: type[BaseModel], seen: set[type[BaseModel]]) -> list[str]:
    """The lines that a page has for the keys of a section and of those inside it."""
    seen.add(section)
    found = []
    for name, field in keys_of(section):
        assert field.description, f"{section.__name__}.{name}"
        found.append(f"| `{name}` |")
        pending = [field.annotation]
        while pending:
            each = pending.pop()
            if isinstance(each, type) and issubclass(each, BaseModel):
                found += keys(each, seen) if each not in seen else []
            else:
                pending += getattr(each, "__args__", ())
    return found


@pytest.mark.parametrize("section", [Config, SweepSections, LimitsSections])
def test_every_key_is_described(section):
    page = keys_page()
    lines = keys(section, set())
    assert len(lines) > 5
    assert [line for line in lines if line not in page] == []


RUN = {"time": "time", "rows": [0, 50], "inputs": {"F": "force"}, "outputs": {"y": "position"}}
NAMED = [{"id": f"e{i}", "data": str(DATA / f"exp{1 + i % 3}.csv")} for i in range(6)]
UNKNOWN = {"m": {"start": 1.0, "bounds": [0.1, 10.0]}, "k": {"start": 25.0, "bounds": [1.0, 200.0]}}
BASE = {
    "model": {"fmu": str(SPRING)},
    "parameters": UNKNOWN,
    "experiments": [RUN | named | {"sigma": {"y": 0.002}} for named in NAMED],
}
BASE["experiments"][5]["role"] = "test"
FIRST, SECOND, *_ = BASE["experiments"]
OBSERVED = [
    FIRST | {"outputs": {"y": {"column": "position", "free_scale": True}}},
    SECOND | {"outputs": {"y": {"column": "position", "ordinal": True}}},
]
FRONT = {"population": 8, "max_generations": 3, "objectives": "experiments"}
ALL = {"profiles": ["m"], "bootstrap": 10, "posterior": 400, "walkers": 8}
KINDS = {
    "fit": {
        "constraints": [{"expression": "m <= k"}], "multistart": {"n": 2}, "uncertainty": ALL,
    },
    "front": {"method": {"name": "nsga2", "options": FRONT}},
    "close-loop": {"closed_loop": {"effects": ["bias"], "sites": ["output y"], "max_effects": 1}},
    "sensitivity": {"sensitivity": {"groups": 4}},
    "observed": {"experiments": OBSERVED},
    "shot": {"method": {"shooting": {"segments": 3}}},
}  # fmt: skip
"""What a config has besides, by the name of a command or of another fit."""


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Callable[[str], Path]:
    """The folder of a run of a kind, which is made when it is first asked for."""
    folder = tmp_path_factory.mktemp("runs")
    limits = {"duration": 4.0, "sample_time": 0.1, "candidates": 10}
    limits |= {"inputs": {"F": {"lower": -1.0, "upper": 1.0}}}
    axis = {"name": "start", "key": "parameters.m.start", "values": [1.0]}
    files = {name: BASE | extra for name, extra in KINDS.items()}
    files["limits"] = limits
    for study in ("close-loop", "sensitivity"):
        files[f"sweep {study}"] = {"study": study, "configs": [f"{study}.toml"], "axes": [axis]}
    for name, tree in files.items():
        (folder / f"{name}.toml").write_text(to_toml(tree))

    @cache
    def made(name: str) -> Path:
        first = name.partition(" ")[0]
        command = first if first in ("close-loop", "sensitivity", "sweep") else "fit"
        given, out = [command, str(folder / f"{name}.toml")], folder / name
        if name == "design":
            given = ["design", str(made("fit")), "--limits", str(folder / "limits.toml")]
            out = folder / "design.csv"
        assert main([*given, "--out", str(out)]) in (0, 1)  # the front is cut short
        return folder / name

    return made


def columns(run: Path) -> dict[str, dict[str, str]]:
    """Names and types of the columns of each table in a folder."""
    found = {}
    for path in run.glob("*.parquet"):
        schema = pq.read_schema(path)
        found[path.stem] = {field.name: str(field.type) for field in schema}
    if (run / "evaluations").is_dir():
        schema = read_log(run / "evaluations").schema
        found["evaluations"] = {field.name: str(field.type) for field in schema}
    return found


def plain(type_: str) -> str:
    """Parquet calls a list's items "element", and one without items has no type."""
    return "list" if type_.startswith("list<") else type_


def described() -> dict[str, list[dict[str, str]]]:
    """What the page says: for each table the types of its columns, and those of a closed loop."""
    found = {}
    page = (ROOT / "cluster_est" / "docs" / "tables.md").read_text(encoding="utf-8")
    for section in page.split("\n## ")[1:]:
        name, _, text = section.partition("\n")
        always, _, in_loops = text.partition("In runs of `close-loop` also:")
        found[name] = [
            {column: plain(unescape(type_)) for column, type_ in COLUMN.findall(part)}
            for part in (always, in_loops)
        ]
    return found


COLUMN = re.compile(r"^\| `([^`]+)` \| ([^|]+) \| [^|]* \| [^|]*\w[^|]* \|$", re.MULTILINE)
"""With a meaning."""
DESCRIBED = described()


OTHERS = sorted({*KINDS, "design"} - {"fit", "close-loop"})


@pytest.mark.parametrize(
    "name", ["fit", "close-loop", *(pytest.param(n, marks=pytest.mark.slow) for n in OTHERS)]
)
def test_every_column_that_a_run_writes_is_described(run, name):
    for table, found in columns(run(name)).items():
        always, in_loops = DESCRIBED[table]
        known = always | (in_loops if name == "close-loop" else {})
        if table == "next_input":
            known |= dict.fromkeys(("F", "y"), "double")  # inputs and outputs of this model
        if found:  # a table without rows has no columns
            assert {key: plain(type_) for key, type_ in found.items()} == known, table


@pytest.mark.slow
def test_every_column_of_a_sweeps_summary_is_described(run):
    found = columns(run("sweep close-loop"))["summary"]
    found |= columns(run("sweep sensitivity"))["summary"]
    known = {k: v for k, v in found.items() if k != "start" and not k.startswith("parameter ")}
    said, _ = DESCRIBED["summary"]
    assert set(known) == set(said)
    assert {k: v for k, v in known.items() if v != "null"}.items() <= said.items()


@pytest.mark.slow
def test_every_table_that_is_described_is_written_by_some_run(run):
    written = {
        table for name in (*KINDS, "design", "sweep close-loop") for table in columns(run(name))
    }
    assert set(DESCRIBED) - written <= {"directions"}  # where something is not determined


def test_every_form_is_on_the_page_under_its_site():
    head, *sections = forms_page().split("\n## ")
    assert "(form_shapes.svg)" in head
    assert [s.partition("\n")[0] for s in sections] == [site for site, _ in SITES.values()]
    for kind, section in zip(SITES, sections, strict=True):
        for form in (form for (site, _), form in EVERY_FORM.items() if site == kind):
            row = next(line for line in section.splitlines() if line.startswith(f"| `{form.name}`"))
            plain = not form.free and not form.memory
            assert not plain or f"`{form.equation}`" in row
            assert all(f"`{c.name}`" in row for c in form.coefficients)
