import dataclasses
import importlib
import inspect
import pkgutil
import re

import pytest
from support.problems.springs import ROOT

import cluster_est.closed_loop
from cluster_est.closed_loop import search
from cluster_est.closed_loop.selection.gates import FILTERS, GATES, STOPS
from cluster_est.closed_loop.selection.moves import MOVES
from cluster_est.closed_loop.settings import LoopPart, LoopStage
from cluster_est.running.progress_line import SEARCH_TITLES

ORIGINS = ("Theory", "Signal", "Benchmark", "Memory", "By definition", "Setting")
ROOMS = pkgutil.walk_packages(cluster_est.closed_loop.__path__, "cluster_est.closed_loop.")
GROUPS = {
    name: group
    for room in ROOMS
    for name, group in inspect.getmembers(importlib.import_module(room.name), inspect.isclass)
    if name.endswith("Thresholds")
}


@pytest.mark.parametrize("stage", LoopStage)
def test_a_stage_has_a_text_for_people(stage):
    assert SEARCH_TITLES[stage.value]


def test_names_in_the_log_stay_what_they_are():
    assert [stage.value for stage in LoopStage] == [
        "weights", "base", "leave one out", "course", "tests", "probe", "trial", "candidate",
        "enlarged", "drop", "final", "process noise",
    ]  # fmt: skip


@pytest.mark.parametrize("name", GROUPS)
def test_each_threshold_says_where_it_comes_from(name):
    group = GROUPS[name]
    said = (group.__doc__ or "").partition("----------\n")[2]
    entries = re.split(r"\n(?=    \w[\w, ]*\n)", "\n" + said)[1:]
    described = {}
    for entry in entries:
        names, _, text = entry.strip().partition("\n")
        described |= dict.fromkeys(re.split(r", ", names), text)
    assert set(described) == {field.name for field in dataclasses.fields(group)}
    for threshold, text in described.items():
        assert any(origin in text for origin in ORIGINS), threshold


def test_there_are_thresholds_in_every_room_that_decides():
    assert len(GROUPS) >= 8


def test_moves_and_gates_have_names_of_their_own_and_say_where_they_come_from():
    named = [each.part for each in (*MOVES, *STOPS, *FILTERS, *GATES) if each.part]
    assert len(named) == len(set(named))
    assert set(named) <= set(LoopPart)
    for each in (*STOPS, *FILTERS, *GATES):
        assert each.origin.partition(":")[0].capitalize() in ORIGINS


@pytest.mark.parametrize("part", LoopPart)
def test_every_part_is_in_the_table_of_parts(part):
    page = (ROOT / "cluster_est" / "docs" / "how_it_works.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    assert any(f"`{part}`" in row for row in rows)


def test_the_page_for_contributors_quotes_the_recipe_as_it_stands_in_its_file():
    lines = (search.__doc__ or "").splitlines()
    recipe = "\n".join(line for line in lines if line.startswith("    "))
    assert "choose the best that passes all gates" in recipe
    assert recipe in (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
