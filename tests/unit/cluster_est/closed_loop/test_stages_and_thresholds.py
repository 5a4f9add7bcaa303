import dataclasses
import re

import pytest

from cluster_est import LoopSettings
from cluster_est.closed_loop.settings import LoopStage, stage_title

THRESHOLDS = LoopSettings().thresholds
GROUPS = [group.name for group in dataclasses.fields(THRESHOLDS)]
ORIGINS = ("Theory", "Signal", "Benchmark", "Memory", "By definition")


@pytest.mark.parametrize("stage", LoopStage)
def test_a_stage_is_found_by_its_name_in_the_log(stage):
    assert LoopStage(stage.value) is stage
    assert stage_title(stage.value) == stage.title != ""


def test_names_in_the_log_stay_what_they_are():
    assert [stage.value for stage in LoopStage] == [
        "weights", "base", "leave one out", "course", "tests", "probe", "trial", "candidate",
        "enlarged", "return", "other starts", "swap", "drop", "final",
        "process noise",
    ]  # fmt: skip


def test_a_search_of_no_stage_keeps_its_name():
    assert stage_title("before") == "before"


@pytest.mark.parametrize("name", GROUPS)
def test_each_threshold_says_where_it_comes_from(name):
    group = getattr(THRESHOLDS, name)
    said = (type(group).__doc__ or "").partition("----------\n")[2]
    entries = re.split(r"\n(?=    \w[\w, ]*\n)", "\n" + said)[1:]
    described = {}
    for entry in entries:
        names, _, text = entry.strip().partition("\n")
        described |= dict.fromkeys(re.split(r", ", names), text)
    assert set(described) == {field.name for field in dataclasses.fields(group)}
    for threshold, text in described.items():
        assert any(origin in text for origin in ORIGINS), threshold
