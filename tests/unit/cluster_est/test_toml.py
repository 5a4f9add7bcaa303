import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cluster_est.toml import dotted, inline, to_toml

NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
PLAIN = st.one_of(st.booleans(), st.integers(), st.floats(allow_nan=False), NAMES)
TREES = st.recursive(
    st.dictionaries(NAMES, PLAIN, max_size=3),
    lambda inner: st.dictionaries(NAMES, PLAIN | inner | st.lists(PLAIN | inner, max_size=3)),
    max_leaves=8,
)


@settings(max_examples=60)
@given(TREES)
def test_any_tree_comes_back(tree):
    assert tomllib.loads(to_toml(tree)) == tree
    line = inline(tree)
    assert "\n" not in line
    assert tomllib.loads(f"v = {line}") == {"v": tree}


@pytest.mark.parametrize(
    ("tree", "text"),
    [
        ({"a": None, "b": 1}, "b = 1\n"),
        ({"a": {"b": None}}, "[a]\n"),
        ({"a": (1.0, float("inf"))}, "a = [\n    1.0,\n    inf,\n]\n"),
        ({"a": float("nan"), "b": float("-inf")}, "a = nan\nb = -inf\n"),
        ({"a": np.float64(0.1)}, "a = 0.1\n"),
        ({"der(x)": "é\x7f"}, '"der(x)" = "é\\u007f"\n'),
        ({"a": [{"b": "c" * 90}, {"b": None}]}, f'[[a]]\nb = "{"c" * 90}"\n\n[[a]]\n'),
        ({"a": [1, {"b": True, "c": None}]}, "a = [\n    1,\n    { b = true },\n]\n"),
    ],
)
def test_what_is_written(tree, text):
    assert to_toml(tree) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([1.0, float("inf"), 1e-05], "[1.0, inf, 1e-05]"),
        ({"a.b": {"c": None, "d": (True, "x\n")}}, '{ "a.b" = { d = [true, "x\\n"] } }'),
        (Path("a/b"), '"a/b"'),
    ],
)
def test_a_value_stands_on_one_line(value, text):
    assert inline(value) == text


@given(st.lists(NAMES, min_size=1, max_size=3))
def test_any_key_is_read_as_its_parts(parts):
    tree = tomllib.loads(f"{dotted(*parts)} = 1")
    for part in parts:
        assert list(tree) == [part]
        tree = tree[part]
    assert tree == 1


def test_parts_of_a_key_have_quotes_where_they_need_them():
    assert dotted("inputs", "der(x)", "") == 'inputs."der(x)".""'
