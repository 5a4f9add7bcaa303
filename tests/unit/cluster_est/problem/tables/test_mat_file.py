"""Tags of MAT files are read as SciPy reads them, and refused where they are damaged."""

from __future__ import annotations

import io
import random
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat, whosmat

from cluster_est.errors import DataError
from cluster_est.problem.tables.files import read_table
from cluster_est.problem.tables.mat_file import contents

VARIABLES = {
    "t": np.linspace(0.0, 1.0, 5),
    "count": np.arange(5, dtype=np.int8),
    "turned": np.arange(5.0) + 1j,
    "flags": np.array([True, False]),
    "nothing": np.zeros((0, 0)),
    "table": np.ones((2, 3, 2), np.uint16),
    "a_name_that_is_long_for_one": np.ones(1),
    "words": "some text",
    "inner": {"t": np.arange(3.0), "more": {"deep": 1}},
    "cells": np.array([1.0, "a", np.arange(3)], dtype=object),
}
NUMBERS = [name for name in VARIABLES if name not in ("words", "inner", "cells")]


def packed(compressed: bool = False) -> bytes:
    file = io.BytesIO()
    savemat(file, VARIABLES, do_compression=compressed, long_field_names=True)
    return file.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
def test_names_are_those_that_scipy_finds(compressed):
    file = packed(compressed)
    found = contents(file)
    assert found is not None
    assert list(found.numbers) == NUMBERS
    assert found.others == {"words": "text", "inner": "a structure", "cells": "a cell array"}
    assert {*found.numbers, *found.others} == {name for name, _, _ in whosmat(io.BytesIO(file))}


def test_a_file_without_tags_is_left_to_scipy():
    old = io.BytesIO()
    savemat(old, {"t": np.arange(3.0)}, format="4")
    assert contents(old.getvalue()) is None
    assert contents(b"") is None
    assert contents(b"MATLAB 7.3".ljust(125) + b"\2IM") is None


def test_a_big_endian_file_is_read():
    body = b"".join(
        [
            np.array([6, 8, 6, 0], ">u4").tobytes(),
            np.array([5, 8, 1, 2], ">i4").tobytes(),
            np.array([1 << 16 | 1], ">u4").tobytes() + b"t\0\0\0",
            np.array([9, 16], ">u4").tobytes() + np.array([1.0, 2.0], ">f8").tobytes(),
        ]
    )
    head = b"MATLAB 5.0".ljust(124) + b"\1\0MI"
    found = contents(head + np.array([14, len(body)], ">u4").tobytes() + body)
    assert found is not None
    assert found.numbers == ("t",)


@pytest.mark.parametrize("compressed", [False, True])
def test_any_damage_is_met_with_a_sentence(tmp_path: Path, compressed):
    """Some of it makes SciPy end the process where nobody looks before."""
    chance, whole = random.Random(1), packed(compressed)
    path = tmp_path / "a.mat"
    refused = 0
    for position in chance.choices(range(len(whole)), k=400):
        damaged = bytearray(whole)
        damaged[position] = chance.randrange(256)
        path.write_bytes(damaged[: chance.choice([len(damaged), len(damaged), position])])
        try:
            assert "t" in read_table(path, "here").columns or position > 128
        except DataError as error:
            assert str(error).startswith(f"here: {path} ")  # noqa: PT017
            refused += 1
    assert refused > 100


def test_the_data_of_numbers_must_have_the_size_that_its_dimensions_say():
    whole = packed()
    dimensions = np.array([5, 8, 1, 5], "<i4").tobytes()
    assert dimensions in whole
    wrong = whole.replace(dimensions, np.array([5, 8, 1, 6], "<i4").tobytes(), 1)
    with pytest.raises(ValueError, match="a tag says 40 bytes of kind 9"):
        contents(wrong)
