import shutil
from pathlib import Path

import numpy as np
import pytest
from support.cut_logs import cut
from support.run_folders import facts, facts_without_clocks, leave_as_killed, rows, tables
from support.truth.springs_with_friction import FRICTION, NOISE, write_config

from cluster_est.cli import main
from cluster_est.run_folder.log_segment import read_log

SPOILED = {"run0": (30, 77), "run1": (50, 99), "run2": (64,)}
"""Samples that are off by 20 times the noise."""

KEPT = ["log.keep_residuals=true"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("outliers")
    config = write_config(folder)
    for name, off in SPOILED.items():
        path = folder / f"{name}.csv"
        lines = path.read_text().splitlines()
        for row in off:
            *rest, value = lines[1 + row].split(",")
            lines[1 + row] = ",".join([*rest, repr(float(value) + 20.0 * NOISE)])
        path.write_text("\n".join(lines))
    assert main(["close-loop", str(config), "--out", str(folder / "run"), *KEPT]) == 0
    return folder / "run"


def test_the_friction_is_found_and_the_outliers_are_counted(run: Path) -> None:
    found = facts(run)
    assert found["verdict"] == "found"
    (effect,) = found["effects"]
    assert effect["form"] == "coulomb"
    assert effect["parameters"]["k"]["value"] == pytest.approx(FRICTION, rel=0.05)
    (note,) = (note for note in found["notes"] if "outlier" in note)
    assert note.startswith("outliers were left out of fits, errors and tables: y 4 of 240 training")
    assert "and y 1 of 120 held-out samples (up to" in note


def test_tables_are_without_them(run: Path) -> None:
    for name, off in SPOILED.items():
        own = [row["time"] for row in rows(run, "residuals") if row["experiment"] == name]
        kept = np.delete(np.arange(120) * 0.02, off)
        assert own == pytest.approx(kept.tolist())
    errors = rows(run, "errors")
    assert [row["samples"] for row in errors] == [118, 118, 119]
    assert [row["rmse_after"] for row in errors] == pytest.approx([NOISE] * 3, rel=0.3)


def test_a_fit_with_what_the_loop_says_has_the_same_samples_and_cost(
    run: Path, tmp_path: Path
) -> None:
    found = facts(run)
    expected = {name: {"y": [0.02 * row for row in off]} for name, off in SPOILED.items()}
    assert found["left_out"].keys() == expected.keys()
    for name, own in expected.items():
        assert found["left_out"][name]["y"] == pytest.approx(own["y"])
    (note,) = (
        note
        for note in found["notes"]
        if "to leave out the same samples in cluster-est fit" in note
    )
    assert "left_out.y = [0.6, 1.54] to experiment 'run0'" in note
    text = (run.parent / "config.toml").read_text()
    for name, own in found["left_out"].items():
        text = text.replace(f'id = "{name}"', f'id = "{name}"\nleft_out.y = {own["y"]}')
    config = run.parent / "same_samples.toml"
    config.write_text(text + "\n" + found["effects"][0]["config"])
    assert main(["fit", str(config), "--out", str(tmp_path / "fit")]) == 0
    assert facts(tmp_path / "fit")["cost"] == pytest.approx(found["cost"], rel=1e-6)


@pytest.mark.parametrize(
    "shares", [(0.5,), pytest.param((0.9, 1.0, 0.05, 0.98, 0.7), marks=pytest.mark.slow)]
)
@pytest.mark.slow
def test_a_resumed_run_is_the_same(run: Path, tmp_path: Path, shares: tuple[float, ...]) -> None:
    """In all of its tables and all that it says, from a log that has its residuals."""
    again = tmp_path / "again"
    shutil.copytree(run, again)
    config, command = run.parent / "config.toml", ["close-loop", "--out", str(again), "--resume"]
    for share in shares:
        leave_as_killed(again)
        cut(again / "evaluations", int(share * read_log(run / "evaluations").num_rows))
        assert main([*command, str(config), *KEPT]) == 0
        assert facts_without_clocks(again) == facts_without_clocks(run)
        assert tables(again) == tables(run)
    assert np.isfinite(rows(run, "structures")[0]["relative_steps"])
