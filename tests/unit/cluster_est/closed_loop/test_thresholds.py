"""Every threshold of a closed loop says where it comes from."""

from __future__ import annotations

import dataclasses
import re

import pytest

from cluster_est.closed_loop.thresholds import LoopThresholds

GROUPS = {group.name: getattr(LoopThresholds(), group.name)
          for group in dataclasses.fields(LoopThresholds)}  # fmt: skip
ORIGINS = ("Theory", "Signal", "Benchmark", "Memory", "By definition")


@pytest.mark.parametrize("name", GROUPS)
def test_each_threshold_says_where_it_comes_from(name):
    said = (type(GROUPS[name]).__doc__ or "").partition("----------\n")[2]
    entries = re.split(r"\n(?=    \w[\w, ]*\n)", "\n" + said)[1:]
    described = {}
    for entry in entries:
        names, _, text = entry.strip().partition("\n")
        described |= dict.fromkeys(re.split(r", ", names), text)
    assert set(described) == {field.name for field in dataclasses.fields(GROUPS[name])}
    for threshold, text in described.items():
        assert any(origin in text for origin in ORIGINS), threshold
