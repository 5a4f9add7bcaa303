import re

import pytest
from support.docs_blocks import PAGES
from support.problems.springs import ROOT

from cluster_est import Resources
from cluster_est.executors import EXECUTORS
from cluster_est.methods import SEARCH_METHODS
from cluster_est.problem.costs import COSTS
from workers.effects.forms import FORMS

DOCS = ROOT / "cluster_est" / "docs"
TEST = re.compile(r"`(tests/[\w/]+\.py)((?:::\w+)*)`")
PLACE = re.compile(r"`((?:cluster_est|workers|tests|scripts|configs)/[\w./-]+)`")
LINK = re.compile(r"\]\(([^)#:]+)\)")


def missing_test(path: str, names: str) -> bool:
    file = ROOT / path
    source = file.read_text(encoding="utf-8") if file.is_file() else ""
    wanted = [name for name in names.split("::") if name]
    return not source or not all(re.search(rf"(class|def) {n}\b", source) for n in wanted)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_test_and_every_file_that_a_page_names_exists(page):
    text = page.read_text(encoding="utf-8")
    assert [path + names for path, names in TEST.findall(text) if missing_test(path, names)] == []
    places = [place for place in PLACE.findall(text) if "NAME" not in place]
    assert [place for place in places if not (ROOT / place).exists()] == []
    assert [link for link in LINK.findall(text) if not (page.parent / link).exists()] == []


@pytest.mark.parametrize(
    ("names", "page", "cell"),
    [(SEARCH_METHODS, "which_method.md", "`{}`"), (EXECUTORS, "long_runs.md", "| `{}` |")],
)
def test_every_plug_in_is_in_the_page_that_helps_to_choose(names, page, cell):
    text = (DOCS / page).read_text(encoding="utf-8")
    missing = [name for name in names if cell.format(name) not in text]
    assert missing == [], f"add a row to cluster_est/docs/{page}"


def test_every_executor_is_in_the_docstring_of_resources():
    assert [name for name in EXECUTORS if f'"{name}"' not in str(Resources.__doc__)] == []


@pytest.mark.parametrize(
    ("section", "names"), [("method", SEARCH_METHODS), ("cost", COSTS), ("executor", EXECUTORS)]
)
def test_every_plug_in_that_a_config_can_choose_is_in_the_reference(section, names):
    reference = (ROOT / "configs" / "reference.toml").read_text(encoding="utf-8")
    key = re.search(rf"^\[{section}\].*?^(name = .*?)$", reference, re.MULTILINE | re.DOTALL)
    missing = [name for name in names if f'"{name}"' not in key[1]]
    assert missing == [], f"add it to the line of {section}.name in configs/reference.toml"


def test_every_form_is_in_the_table_of_forms():
    starts = {"derivative": "`der(STATE)`", "pair": "`pair ", "input": "`input ",
              "output": "`output ", "parameter": "`parameter "}  # fmt: skip
    lines = (DOCS / "adding_effects.md").read_text(encoding="utf-8").splitlines()
    rows = {k: next(line for line in lines if line.startswith(f"| {v}")) for k, v in starts.items()}
    missing = [(kind, name) for kind, name in FORMS if f"`{name}`" not in rows[kind]]
    assert missing == [], "add the form to the table of forms in cluster_est/docs/adding_effects.md"
