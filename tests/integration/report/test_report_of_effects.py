import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.drawn import Figures
from support.reported import Page
from support.run_folders import facts, rows
from support.truth.springs_with_friction import FRICTION, WIDTH, write_config

from cluster_est.cli import main
from cluster_est.html_report.page import write_report
from cluster_est.problem.display import percent


@pytest.fixture(scope="module")
def closed(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("closed")
    config = write_config(folder)
    assert main(["close-loop", str(config), "--out", str(folder / "run")]) == 0
    return folder / "run"


@pytest.fixture(scope="module")
def figures(closed) -> Figures:
    return Figures(write_report(closed))


@pytest.fixture(scope="module")
def text(closed) -> str:
    return Page(write_report(closed)).text


@pytest.fixture(scope="module")
def shape(closed) -> dict:
    (found,) = rows(closed, "shapes")
    return found


def fitted(closed: Path, name: str, effect: str) -> Path:
    """A fit of the same experiments with an effect in its config."""
    config, out = closed.parent / f"{name}.toml", closed.parent / name
    config.write_text(f"{(closed.parent / 'config.toml').read_text()}\n{effect}")
    assert main(["fit", str(config), "--out", str(out), "--no-report"]) == 0
    return out


def test_a_closed_loop_shows_its_effect_with_its_band_and_where_the_data_were(
    closed, figures, text, shape
):
    for said in ("Found: Coulomb friction at der(v)", "Missing effects", "Candidates"):
        assert said in text
    x, y, low, high = (np.array(shape[name]) for name in ("x", "y", "lower", "upper"))
    assert (shape["part"], shape["variable"], shape["variable_unit"]) == ("der(v)", "v", "m/s")
    assert shape["unit"] == "m/s^2"
    fast = np.abs(x) > 5.0 * WIDTH
    assert y[fast] == pytest.approx(-FRICTION * np.sign(x[fast]), rel=0.05)
    assert np.all((low <= y) & (y <= high))
    (row,) = [row for row in rows(closed, "effects") if row["coefficient"] == "k"]
    assert (high - low)[fast] == pytest.approx(2 * 1.96 * row["std_error"], rel=0.01)
    samples = pq.read_table(closed / "trajectories.parquet").to_pandas()
    train = pq.read_table(closed / "errors.parquet").to_pandas().query("role == 'train'")
    expected = samples[samples.experiment.isin(train.experiment)]
    assert sum(shape["counts"]) == len(expected)
    figure = figures.by_id(f"shape-{shape['effect']}-0")
    across, up = figure.plots[0].curve("effect")
    drawn = np.interp(across, x, y)
    assert up[np.abs(across) > 5.0 * WIDTH] == pytest.approx(
        drawn[np.abs(across) > 5.0 * WIDTH], abs=2.0 * figure.plots[0].grain(figure.plots[0].y)
    )


def test_its_equation_picture_and_coefficients_stand_on_the_first_screen(closed, figures, text):
    head = text.partition("What to know")[0].partition("Parameters Errors before")[0]
    assert text.count("der(v) += -k * tanh(v / width) With k = 0.60") == 1
    assert "der(v) += -k * tanh(v / width) With k = 0.60" in head
    assert "coulomb_v.k Coulomb friction 0.60" in head
    assert f"cluster-est export {closed} --fmu repaired.fmu" in head
    drawn = [figure.attributes.get("id") for figure in figures.found]
    assert drawn[:3] == ["shape-coulomb_v-0", "held-out", "worst"]
    assert drawn.count("shape-coulomb_v-0") == 1


def test_what_the_residuals_ask_for_without_a_form_is_the_friction(figures, shape):
    at, free, error = (np.array(shape[name]) for name in ("free_x", "free_y", "free_error"))
    assert len(at) >= 8
    inside = np.histogram(at, shape["edges"])[0]
    assert inside.sum() == len(at)
    known = (np.abs(at) > 5.0 * WIDTH) & (error < 0.2 * FRICTION)
    assert known.sum() >= 4
    truth = -FRICTION * np.sign(at[known])
    assert np.all(np.abs(free[known] - truth) < 4.0 * error[known] + 0.1 * FRICTION)
    plot = figures.by_id(f"shape-{shape['effect']}-0").plots[0]
    across, up = plot.curve("estimate from the residuals")
    order = [int(np.abs(at - x).argmin()) for x in across]
    assert up == pytest.approx(free[order], abs=plot.grain(plot.y))


def test_a_fit_shows_the_shapes_of_the_effects_that_it_declares(closed, shape):
    """The effect is declared as the loop has written it."""
    (effect,) = facts(closed)["effects"]
    declared = fitted(closed, "declared", effect["config"])
    (own,) = rows(declared, "shapes")
    for name in ("effect", "part", "variable", "variable_unit", "unit"):
        assert own[name] == shape[name]
    low, high = (np.interp([-0.5, 0.5], row["x"], row["y"]) for row in (own, shape))
    assert low == pytest.approx(high, rel=0.02)
    assert sum(own["counts"]) == sum(shape["counts"])
    page = Page(write_report(declared))
    assert "Declared effects" in page.text
    assert "der(v) over v (m/s), in the range of the training data" in page.text


@pytest.mark.slow
def test_a_difference_has_the_same_shape_with_and_without_blanks(closed):
    spring = 'name = "spring"\nsite = "der(v)"\nform = "linear"\nparameters.k.start = -0.1'
    shapes = [
        rows(fitted(closed, name, f'[[effects]]\n{spring}\nvariables = ["{of}"]'), "shapes")
        for name, of in (("apart", "x - v"), ("together", "x-v"))
    ]
    (apart,), (together,) = shapes
    assert sum(apart["counts"]) > 100
    assert (together["x"], together["y"]) == (apart["x"], apart["y"])


def test_the_likely_sets_of_effects_are_named_with_their_probabilities(closed, text):
    said, sets = facts(closed)["likely"], rows(closed, "structures")
    known = sorted((row["probability"] for row in sets if row["probability"] >= 0.0), reverse=True)
    assert sum(known) == pytest.approx(1.0)
    assert f"the probability is {percent(known[0])} for coulomb at der(v)" in said
    assert f"{said}." in text
    assert text.count(percent(known[0])) >= 2  # there, and in the table of the step


def test_how_often_the_effect_is_chosen_again_is_said(closed, text, capsys):
    said, sets = facts(closed)["resampled"], rows(closed, "structures")
    shares = {tuple(row["effects"]): row["chosen"] for row in sets if row["chosen"] >= 0.0}
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares["coulomb at der(v)",] > 0.5
    assert (
        f"set of effects was coulomb at der(v) in {percent(shares['coulomb at der(v)',])}" in said
    )
    assert f"{said[:1].upper()}{said[1:]}." in text
    assert main(["show", str(closed)]) == 0
    assert " ".join(said.split()) in " ".join(capsys.readouterr().out.split())


def test_the_path_of_the_search_has_every_set_of_effects(closed, figures):
    sets = [row for row in rows(closed, "structures") if row["effects"]]
    sets.sort(key=lambda row: (row["step"], -row["closed"]))
    figure = figures.by_id("steps")
    (plot,) = figure.plots
    assert [t for t in figure.texts if t[:2] in {f"{row['step']}:" for row in sets}] == [
        f"{row['step']}: {' + '.join(row['effects'])}" for row in sets
    ]
    accepted, _ = plot.by_row("accepted", len(sets))
    expected = [100.0 * row["closed"] for row in sets if row["accepted"]]
    assert accepted == pytest.approx(expected, abs=plot.grain(plot.x))


def test_searches_of_one_name_are_points_in_their_order(closed, figures):
    (plot,) = figures.by_id("convergence").plots
    lines = [json.loads(line) for line in (closed / "progress.jsonl").read_text().splitlines()]
    lines = [line for line in lines if "search" in line]
    drawn = {}
    for name in plot.paths:
        across, up = plot.curve(name)
        drawn |= dict(zip(np.rint(across).astype(int).tolist(), up.tolist(), strict=True))
    expected = {i: line["cost"] for i, line in enumerate(lines) if line["cost"] is not None}
    assert drawn.keys() == expected.keys()
    for number, cost in expected.items():
        assert drawn[number] == pytest.approx(cost, rel=2e-3)
