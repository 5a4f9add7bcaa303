"""The stages of a closed loop, in the log and for people."""

from __future__ import annotations

import pytest

from cluster_est.closed_loop.stages import LoopStage, stage_title


@pytest.mark.parametrize("stage", LoopStage)
def test_a_stage_is_found_by_its_name_in_the_log(stage):
    assert LoopStage(stage.value) is stage
    assert stage_title(stage.value) == stage.title != ""


def test_names_in_the_log_stay_what_they_are():
    assert [stage.value for stage in LoopStage] == [
        "weights", "base", "leave one out", "course", "probe", "trial", "candidate", "enlarged",
        "return", "other starts", "swap", "drop", "final",
        "process noise",
    ]  # fmt: skip


def test_a_search_of_no_stage_keeps_its_name():
    assert stage_title("before") == "before"
