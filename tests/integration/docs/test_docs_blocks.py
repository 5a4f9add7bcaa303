"""Every block of code in the README and the pages does what the text says."""

from __future__ import annotations

import importlib.util
import shlex
import shutil
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
from support.docs_blocks import BLOCKS, COMMANDS, Block, complete
from support.problems.springs import ROOT

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.cli.commands import COMMANDS as KNOWN
from cluster_est.cli.parser import parse
from cluster_est.config.options import build_method
from cluster_est.config.reader import parse_config
from cluster_est.config.sections.design import LimitsSections
from cluster_est.config.sections.sweep import SweepSections
from cluster_est.costs import COSTS
from cluster_est.methods import METHODS
from workers.effects import forms

EXAMPLE = ROOT / "configs" / "data" / "mass_spring_damper"
FIRST = next(b for b in BLOCKS if b.page.name == "first_fit.md" and complete(b))
PYTHON = [b for b in BLOCKS if b.language == "python" and not b.title]
TOML = [b for b in BLOCKS if b.language == "toml"]


def titled(ending: str) -> Block:
    """The block whose title ends so."""
    (found,) = [b for b in BLOCKS if b.title.endswith(ending)]
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What the pages assume: a model, two tables, the first config, and a run of it."""
    path = tmp_path_factory.mktemp("user")
    shutil.copy(ROOT / "configs" / "models" / "mass_spring_damper.fmu", path / "model.fmu")
    shutil.copy(EXAMPLE / "exp1.csv", path / "monday.csv")
    shutil.copy(EXAMPLE / "exp5.csv", path / "tuesday.csv")
    (path / "first.toml").write_text(FIRST.text, encoding="utf-8")
    arguments = ["fit", str(path / "first.toml"), "--out", str(path / "runs" / "first")]
    assert main(arguments) == 0
    return path


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Imports a block as the file that its title names."""

    def load(block: Block) -> ModuleType:
        path = tmp_path / Path(block.title).name
        path.write_text(block.text, encoding="utf-8")
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None
        assert spec.loader is not None
        found = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, path.stem, found)
        spec.loader.exec_module(found)
        return found

    return load


@pytest.fixture
def extended(module, monkeypatch):
    """Registers the examples of a method, a cost and a form, each with its one line."""
    method = module(titled("methods/random_search.py"))
    line = titled("in METHODS").text
    for name, kind in eval("{" + line + "}", vars(method)).items():
        monkeypatch.setitem(METHODS, name, kind)
    fair = module(titled("costs/fair.py")).Fair
    monkeypatch.setitem(COSTS, fair.name, fair)
    entry = eval(titled("an entry of _RATES").text, vars(forms))
    for kind in entry.kinds:
        monkeypatch.setitem(forms.FORMS, (kind, entry.name), entry)


def test_every_block_says_what_it_is_and_is_run_by_a_test():
    titles = {b.title for b in BLOCKS if b.title}
    assert len(titles) == 4  # a method, its line, a cost and a form: all run below
    assert {b.language for b in BLOCKS} <= {"python", "toml"}
    assert len(PYTHON) >= 8
    assert len(TOML) >= 9


@pytest.mark.parametrize("block", TOML, ids=str)
def test_a_config_is_one(block, folder, extended):
    tree = tomllib.loads(block.text)
    if "configs" in tree:
        SweepSections.model_validate(tree)
    elif "duration" in tree:
        LimitsSections.model_validate(tree)
    elif complete(block):
        problem = ce.build_problem(parse_config(tree, str(block)), folder)
        assert problem.experiments[0].size > 100
    else:
        parse_config(tomllib.loads(FIRST.text) | tree, str(block))


@pytest.mark.parametrize("page", sorted({b.page.name for b in PYTHON}))
def test_python_runs(page, folder, monkeypatch, capsys):
    """Block after block in one namespace, as a reader would; without Ray."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [str(folder), *sys.path])
    known: dict[str, object] = {"ce": ce, "__name__": "reader"}
    for block in (b for b in PYTHON if b.page.name == page):
        text = block.text.replace('ce.Resources("ray", workers=2)', "ce.Resources(workers=2)")
        exec(compile(text, str(block), "exec"), known)
    assert capsys.readouterr().out


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[f"{p}:{c[:40]}" for p, c in COMMANDS])
def test_a_command_is_one_that_the_command_line_knows(page, line):
    words = shlex.split(line, comments=True)
    while words[0] != "cluster-est":
        words.pop(0)
    given = [word.replace("1234", "1") for word in words[1:]]
    assert parse(given).command in KNOWN


def test_the_commands_of_the_first_fit_run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(["init", "model.fmu", "monday.csv", "tuesday.csv", "--out", "new.toml"]) == 0
    assert "fill in" in capsys.readouterr().out
    text = Path("new.toml").read_text(encoding="utf-8")
    Path("new.toml").write_text(text.replace("FILL IN: ", "").replace('?"', '"'))
    assert main(["check", "new.toml", "--seconds", "0"]) == 0
    assert main(["fit", "new.toml", "--out", "runs/new"]) == 0
    assert main(["show", "runs/new"]) == 0


@pytest.mark.usefixtures("extended")
class TestExtensions:
    def tree(self) -> dict:
        tree = tomllib.loads(FIRST.text)
        del tree["parameters"]["x"]
        return tree

    def test_the_method_lowers_the_cost_and_its_options_are_checked(self, folder):
        tree = self.tree() | {"method": {"name": "random_search", "options": {"points": 16}}}
        config = parse_config(tree, "c.toml")
        problem = ce.build_problem(config, folder)
        result = ce.fit(problem, build_method(config))
        assert result.cost < 0.5 * result.cost_before
        assert result.nfev >= 1 + 12 * 16
        again = ce.fit(problem, build_method(config), ce.Resources(workers=2))
        assert again.x == result.x
        tree["method"]["options"] = {"points": 0}
        config = parse_config(tree, "c.toml")
        with pytest.raises(ce.ClusterEstError, match="points: must be at least 1"):
            build_method(config)

    def test_the_cost_is_minimised_by_least_squares(self, folder):
        tree = self.tree() | {"cost": {"name": "fair", "options": {"scale": 0.01}}}
        problem = ce.build_problem(parse_config(tree, "c.toml"), folder)
        result = ce.fit(problem)
        assert result.success
        far = ce.fit(replace(problem, cost=COSTS["fair"](scale=1e6)))  # then it is the squares
        squares = ce.fit(replace(problem, cost=COSTS["sse"]()))
        assert far.x == pytest.approx(squares.x, rel=1e-3)

    def test_the_form_can_be_named_in_a_config(self, folder):
        block = next(b for b in TOML if 'form = "exponential_drag"' in b.text)
        tree = self.tree() | tomllib.loads(block.text)
        tree["parameters"]["c"] = {"start": 0.0, "fixed": True}
        problem = ce.build_problem(parse_config(tree, "c.toml"), folder)
        result = ce.fit(problem)
        assert result.cost < 0.5 * result.cost_before
        assert result.x["exponential_drag.k"] > 0.0
