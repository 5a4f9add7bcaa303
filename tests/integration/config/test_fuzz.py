"""A result or a sentence, whatever a config, a table or an FMU says; long form: scripts/fuzz.py."""

import itertools
from pathlib import Path

import pytest
from fuzzing.base import CHECK, FIT, Input, judge, write
from fuzzing.inputs import INPUTS
from hypothesis import HealthCheck, given, settings


@pytest.fixture
def folders(own_cache):
    return itertools.count()


def test_the_inputs_are_spoiled_versions_of_ones_that_work(tmp_path, own_cache):
    full = Path(__file__).parents[3] / "scripts" / "fuzzing" / "full.toml"
    for command in (CHECK, FIT):
        whole = Input("config", command, (("config.toml", full.read_bytes()),))
        folder = tmp_path / command[0]
        folder.mkdir()
        write(whole, folder)
        verdict = judge(whole, folder)
        assert verdict.fault == ""
        assert verdict.code == (0 if command is CHECK else 1)  # its budget is small
        assert verdict.said == ""


def examine(folder, spoiled):
    folder.mkdir()
    write(spoiled, folder)
    verdict = judge(spoiled, folder)
    assert verdict.fault == "", verdict.said


@settings(max_examples=50, suppress_health_check=list(HealthCheck))
@given(INPUTS)
def test_any_input_gives_a_result_or_a_sentence(tmp_path, folders, spoiled):
    examine(tmp_path / str(next(folders)), spoiled)


@pytest.mark.slow
@settings(max_examples=400, suppress_health_check=list(HealthCheck))
@given(INPUTS)
def test_many_more_inputs_give_a_result_or_a_sentence(tmp_path, folders, spoiled):
    examine(tmp_path / str(next(folders)), spoiled)
