import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
from docs.run_pictures import closed_loop, pictures
from support.problems.springs import ROOT

from cluster_est.cli import main

NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
TRUE_FRICTION = 0.6 / 1.2
"""m/s^2: scripts/make_example_data.py, 0.6 N on 1.2 kg."""


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("example") / "friction"
    config = ROOT / "configs" / "mass_with_friction.toml"
    assert main(["close-loop", str(config), "--out", str(folder), "--no-report"]) == 0
    return folder


def shown() -> list[str]:
    """The lines of output in the README; one that is too long for the page goes on in the next."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    block = text[text.index("    verdict: ") : text.index("\n\nIf the data cannot distinguish")]
    joined = re.sub(r"\n {10,}", " ", block)
    lines = [line.removeprefix("    ") for line in joined.splitlines() if line]
    return [f"{lines[0]} {lines[1]}", *lines[2:]]


def words(line: str) -> str:
    """A line without its numbers and the width of its columns."""
    return " ".join(NUMBER.sub("#", line).split())


def test_the_readme_shows_what_is_printed(run, capsys):
    assert main(["show", str(run)]) == 0
    printed = {words(line): line for line in capsys.readouterr().out.splitlines()}
    assert len(shown()) == 10
    for line in shown():
        assert words(line) in printed
        found = [float(n) for n in NUMBER.findall(printed[words(line)])]
        assert found == pytest.approx([float(n) for n in NUMBER.findall(line)], rel=0.01)


def test_the_simulations_that_it_takes_are_those_of_the_run(run):
    """A budget of simulations is judged by this number; it is in two pages."""
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    for page in ("README.md", "cluster_est/docs/finding_what_is_missing.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        (said,) = re.findall(r"([\d,]+) (?:simulations\. The benchmark|for the example)", text)
        assert int(said.replace(",", "")) == pytest.approx(facts["simulations"], rel=0.01)


def test_the_friction_that_nothing_declares_is_found(run):
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    (effect,) = facts["effects"]
    assert (facts["verdict"], effect["form"], effect["site"]) == ("found", "coulomb", "der(v)")
    strength = effect["parameters"]["k"]
    assert strength["value"] == pytest.approx(TRUE_FRICTION, rel=0.01)


def test_the_pictures_are_drawn_from_the_run(run):
    docs = ROOT / "cluster_est" / "docs"
    committed = (docs / "closed_loop.svg").read_text(encoding="utf-8")
    for said in ("found: der(v) += -k * tanh(v / width)", "0.0337 before, 0.0018 after"):
        assert said in closed_loop(run)
        assert said in committed
    drawn = dict(pictures(run))
    assert sorted(drawn) == ["report_curves", "report_errors", "report_search", "report_shape"]
    page = (docs / "the_report.md").read_text(encoding="utf-8")
    for name, text in drawn.items():
        assert f"]({name}.svg)" in page
        committed = (docs / f"{name}.svg").read_text(encoding="utf-8")
        titles = [ElementTree.fromstring(each)[0].text for each in (text, committed)]
        assert titles[0] == titles[1]
