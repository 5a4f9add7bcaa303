import ast
import copy
import importlib.util
import shlex
import shutil
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import nbformat
import pytest
from docs.pages import LimitsSections, SweepSections
from nbclient import NotebookClient
from support.docs_blocks import BLOCKS, COMMANDS, Block, complete
from support.problems.springs import ROOT

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.cli.parser import parse
from cluster_est.config.choices import build_method
from cluster_est.config.reader import parse_config
from cluster_est.methods import SEARCH_METHODS
from cluster_est.problem.costs import COSTS
from workers.effects import forms

FIRST = next(b for b in BLOCKS if b.page.name == "first_fit.md" and complete(b))
PYTHON = [b for b in BLOCKS if b.language == "python" and not b.title]
TOML = [b for b in BLOCKS if b.language == "toml"]
NOTEBOOK = ROOT / "cluster_est" / "docs" / "first_fit.ipynb"


def titled(ending: str) -> Block:
    """The block whose title ends so."""
    (found,) = [b for b in BLOCKS if b.title.endswith(ending)]
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What the pages assume: a model, two tables, the first config, and a run of it."""
    path = tmp_path_factory.mktemp("user")
    example = ROOT / "configs" / "data" / "mass_spring_damper"
    shutil.copy(ROOT / "configs" / "models" / "mass_spring_damper.fmu", path / "model.fmu")
    shutil.copy(example / "exp1.csv", path / "monday.csv")
    shutil.copy(example / "exp5.csv", path / "tuesday.csv")
    (path / "first.toml").write_text(FIRST.text, encoding="utf-8")
    assert main(["fit", str(path / "first.toml"), "--out", str(path / "runs" / "first")]) == 0
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
    line = titled("in SEARCH_METHODS").text
    for name, kind in eval("{" + line + "}", vars(method)).items():
        monkeypatch.setitem(SEARCH_METHODS, name, kind)
    fair = module(titled("fair.py")).Fair
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


@pytest.mark.parametrize(
    "page",
    [
        name if name == "first_fit.md" else pytest.param(name, marks=pytest.mark.slow)
        for name in sorted({b.page.name for b in PYTHON})
    ],
)
def test_python_runs(page, folder, monkeypatch, capsys):
    """Block after block in one namespace, as a reader would; without Ray."""
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    known: dict[str, object] = {"ce": ce, "__name__": "reader"}
    for block in (b for b in PYTHON if b.page.name == page):
        text = block.text.replace('ce.Resources("ray", workers=2)', "ce.Resources(workers=2)")
        exec(compile(text, str(block), "exec"), known)
    assert capsys.readouterr().out


@pytest.mark.parametrize("page", sorted({page for page, _ in COMMANDS}))
def test_commands_are_those_that_the_command_line_knows(page):
    for line in (line for name, line in COMMANDS if name == page):
        words = shlex.split(line, comments=True)
        given = [word.replace("1234", "1") for word in words[words.index("cluster-est") + 1 :]]
        assert parse(given).command == given[0], line


def test_the_commands_of_the_first_fit_run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(["init", "model.fmu", "monday.csv", "tuesday.csv", "--out", "new.toml"]) == 0
    assert "fill in" in capsys.readouterr().out
    text = Path("new.toml").read_text(encoding="utf-8")
    Path("new.toml").write_text(text.replace("FILL IN: ", "").replace('?"', '"'))
    assert main(["check", "new.toml", "--seconds", "0"]) == 0
    assert main(["fit", "new.toml", "--out", "runs/new"]) == 0
    assert main(["show", "runs/new"]) == 0


@pytest.fixture
def built(extended, folder):
    """The problem of the first config, with something changed, and the config."""

    def build(**changes):
        tree = tomllib.loads(FIRST.text)
        del tree["parameters"]["x"]
        tree["parameters"] |= changes.pop("parameters", {})
        config = parse_config(tree | changes, "c.toml")
        return ce.build_problem(config, folder), config

    return build


@pytest.mark.slow
def test_the_method_lowers_the_cost_and_its_options_are_checked(built):
    problem, config = built(method={"name": "random_search", "options": {"points": 16}})
    result = ce.fit(problem, build_method(config))
    assert result.cost < 0.5 * result.cost_before
    assert result.nfev >= 1 + 12 * 16
    again = ce.fit(problem, build_method(config), ce.Resources(workers=2))
    assert again.x == result.x
    _, config = built(method={"name": "random_search", "options": {"points": 0}})
    with pytest.raises(ce.ClusterEstError, match="points: must be at least 1"):
        build_method(config)


def test_the_cost_is_minimised_by_least_squares(built):
    problem, _ = built(cost={"name": "fair", "options": {"scale": 0.01}})
    assert ce.fit(problem).success
    far = ce.fit(replace(problem, cost=COSTS["fair"](scale=1e6)))  # then it is the squares
    squares = ce.fit(replace(problem, cost=COSTS["sse"]()))
    assert far.x == pytest.approx(squares.x, rel=1e-3)


def test_the_form_can_be_named_in_a_config(built):
    block = next(b for b in TOML if 'form = "exponential_drag"' in b.text)
    problem, _ = built(**tomllib.loads(block.text), parameters={"c": {"start": 0.0, "fixed": True}})
    result = ce.fit(problem)
    assert result.cost < 0.5 * result.cost_before
    assert result.x["exponential_drag.k"] > 0.0


@pytest.fixture(scope="module")
def stored() -> nbformat.NotebookNode:
    return nbformat.read(NOTEBOOK, as_version=4)


def test_the_notebook_is_stored_without_outputs(stored):
    cells = [cell for cell in stored.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells)


def code_of(stored, *extras):
    """The code cells, without those that need packages besides the extras named."""
    cells = [cell for cell in stored.cells if cell.cell_type == "code"]
    return [cell for cell in cells if set(cell.metadata.get("tags", ())) <= set(extras)]


def test_the_notebook_has_at_most_forty_lines_of_code(stored):
    cells = code_of(stored, "arviz", "optuna")
    lines = [line for cell in cells for line in cell.source.splitlines() if line.strip()]
    assert len(lines) <= 40


def run_cells(cells, known):
    """The value of each cell's last line, None where it is no expression."""
    shown = []
    for cell in cells:
        *body, last = ast.parse(cell.source).body
        exec(compile(ast.Module(body, []), "cell", "exec"), known)
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), "cell", "eval"), known))
        else:
            exec(compile(ast.Module([last], []), "cell", "exec"), known)
            shown.append(None)
    return shown


def test_the_cells_of_the_notebook_run_one_after_the_other(stored, monkeypatch, capsys):
    pytest.importorskip("matplotlib", reason="plots need matplotlib: the extra [plot]").use("Agg")
    monkeypatch.chdir(NOTEBOOK.parent)
    known = {}
    run_cells(code_of(stored), known)
    sys.modules["matplotlib.pyplot"].close("all")
    printed = capsys.readouterr().out
    assert "something is missing from the model" in printed
    assert known["friction"].x["coulomb.k"] == pytest.approx(0.5, rel=0.02)
    compared = ce.compare({"damper": known["damper"], "both": known["friction"]})
    assert compared.best == "both"
    assert compared.models[0].held_out < 1.0


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Jupyter's own parts, ArviZ and Optuna
def test_the_notebook_runs_and_shows_what_its_text_says(stored):
    extras = [name for name in ("arviz", "optuna") if importlib.util.find_spec(name)]
    kept = copy.deepcopy(stored)
    kept.cells = code_of(stored, *extras)
    folder = {"metadata": {"path": str(NOTEBOOK.parent)}}
    cells = NotebookClient(kept, timeout=600, resources=folder).execute().cells
    shown = ["".join(str(each) for each in cell.outputs) for cell in cells]
    assert "Fit: converged" in shown[2]
    assert "Models" in shown[3]
    assert "coulomb.k" in shown[4]
    assert "image/png" in shown[5]
    missing = {"arviz", "optuna"} - set(extras)
    if missing:
        pytest.skip(f"the cells for {' and '.join(sorted(missing))} need these packages")
    assert "r_hat" in shown[6]
    assert len(shown[7].split()) >= 2
