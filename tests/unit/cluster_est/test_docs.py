"""The pages for users name files and tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PAGES = [ROOT / "README.md", *sorted((ROOT / "cluster_est" / "docs").glob("*.md"))]
TEST = re.compile(r"`(tests/[\w/]+\.py)((?:::\w+)*)`")
LINK = re.compile(r"\]\(([^)#:]+)\)")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_test_that_a_page_names_exists(page):
    missing = []
    for path, names in TEST.findall(page.read_text(encoding="utf-8")):
        file = ROOT / path
        source = file.read_text(encoding="utf-8") if file.is_file() else ""
        wanted = [name for name in names.split("::") if name]
        if not source or not all(re.search(rf"(class|def) {name}\b", source) for name in wanted):
            missing.append(path + names)
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_to_a_file_leads_somewhere(page):
    links = LINK.findall(page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_every_method_is_in_the_page_that_helps_to_choose():
    from cluster_est.methods import METHODS

    page = (ROOT / "cluster_est" / "docs" / "which_method.md").read_text(encoding="utf-8")
    missing = [name for name in METHODS if f"`{name}`" not in page]
    assert missing == [], "add a row to cluster_est/docs/which_method.md"


def test_every_plug_in_that_a_config_can_choose_is_in_the_reference():
    from cluster_est.costs import COSTS
    from cluster_est.executors import EXECUTORS
    from cluster_est.methods import METHODS

    reference = (ROOT / "configs" / "reference.toml").read_text(encoding="utf-8")
    for section, names in (("method", METHODS), ("cost", COSTS), ("executor", EXECUTORS)):
        key = re.search(rf"^\[{section}\].*?^(name = .*?)$", reference, re.MULTILINE | re.DOTALL)
        missing = [name for name in names if f'"{name}"' not in key[1]]
        assert missing == [], f"add it to the line of {section}.name in configs/reference.toml"


def test_every_executor_is_where_a_user_chooses_one():
    from cluster_est.executors import EXECUTORS
    from cluster_est.running.resources import Resources

    page = (ROOT / "cluster_est" / "docs" / "long_runs.md").read_text(encoding="utf-8")
    missing = [name for name in EXECUTORS if f"| `{name}` |" not in page]
    assert missing == [], "add a row to cluster_est/docs/long_runs.md"
    said = str(Resources.__doc__)
    missing = [name for name in EXECUTORS if f'"{name}"' not in said]
    assert missing == [], "add it to the docstring of Resources"


def test_every_form_is_in_the_table_of_forms():
    from workers.effects.forms import FORMS

    starts = {"derivative": "`der(STATE)`", "pair": "`pair ", "input": "`input ",
              "output": "`output ", "parameter": "`parameter "}  # fmt: skip
    page = ROOT / "cluster_est" / "docs" / "adding_effects.md"
    lines = page.read_text(encoding="utf-8").splitlines()
    rows = {k: next(line for line in lines if line.startswith(f"| {v}")) for k, v in starts.items()}
    missing = [(kind, name) for kind, name in FORMS if f"`{name}`" not in rows[kind]]
    assert missing == [], "add the form to the table of forms in cluster_est/docs/adding_effects.md"
