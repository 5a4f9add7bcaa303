"""What is written as TOML is read back as it was."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cluster_est.toml import to_toml

NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
PLAIN = st.one_of(st.booleans(), st.integers(), st.floats(allow_nan=False), NAMES)
TREES = st.recursive(
    st.dictionaries(NAMES, PLAIN, max_size=3),
    lambda inner: st.dictionaries(NAMES, PLAIN | inner | st.lists(PLAIN | inner, max_size=3)),
    max_leaves=8,
)


@settings(max_examples=200)
@given(TREES)
def test_any_tree_comes_back(tree):
    assert tomllib.loads(to_toml(tree)) == tree


@pytest.mark.parametrize(
    ("tree", "text"),
    [
        ({"a": None, "b": 1}, "b = 1\n"),
        ({"a": {"b": None}}, "[a]\n"),
        ({"a": (1.0, float("inf"))}, "a = [1.0, inf]\n"),
        ({"a": float("nan"), "b": float("-inf")}, "a = nan\nb = -inf\n"),
        ({"a": np.float64(0.1)}, "a = 0.1\n"),
        ({"der(x)": "é\x7f"}, '"der(x)" = "é\\u007f"\n'),
        ({"a": [{"b": {"c": 1}}, {"b": {}}]}, "[[a]]\n\n[a.b]\nc = 1\n\n[[a]]\n\n[a.b]\n"),
        ({"a": [1, {"b": True, "c": None}]}, "a = [1, { b = true }]\n"),
    ],
)
def test_what_is_written(tree, text):
    assert to_toml(tree) == text
