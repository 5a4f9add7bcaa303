"""Tags of MAT files are read as SciPy reads them, and refused where they are damaged."""

import io
import random
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat, whosmat

from cluster_est import read_table
from cluster_est.errors import DataError

VECTORS = {
    "t": np.linspace(0.0, 1.0, 5),
    "count": np.arange(5, dtype=np.int8),
    "flags": np.array([True, False]),
    "nothing": np.zeros((0, 0)),
    "a_name_that_is_long_for_one": np.ones(2),
}
OTHERS = {
    "turned": (np.arange(5.0) + 1j, "5 complex128"),
    "table": (np.ones((2, 3, 2), np.uint16), "2 x 3 x 2 uint16"),
    "words": ("some text", "text"),
    "inner": ({"t": np.arange(3.0), "more": {"deep": 1}}, "a structure"),
    "cells": (np.array([1.0, "a", np.arange(3)], dtype=object), "a cell array"),
}
DIMENSIONS = np.array([5, 8, 1, 5], "<i4").tobytes()


def packed(compressed: bool = False) -> bytes:
    file = io.BytesIO()
    variables = VECTORS | {name: value for name, (value, _) in OTHERS.items()}
    savemat(file, variables, do_compression=compressed, long_field_names=True)
    return file.getvalue()


def read(folder: Path, content: bytes):
    path = folder / "a.mat"
    path.write_bytes(content)
    return read_table(path, "here")


@pytest.mark.parametrize("compressed", [False, True])
def test_names_are_those_that_scipy_finds(tmp_path, compressed):
    file = packed(compressed)
    table = read(tmp_path, file)
    assert list(table.columns) == list(VECTORS)
    for name, values in VECTORS.items():
        np.testing.assert_array_equal(table.numbers(name, "here"), values.ravel())
    for name, (_, kind) in OTHERS.items():
        with pytest.raises(DataError, match=f"a.mat, column '{name}': .*a vector.*{kind}"):
            table.numbers(name, "here")
    assert {name for name, _, _ in whosmat(io.BytesIO(file))} == {*VECTORS, *OTHERS}


def test_a_file_without_tags_is_left_to_scipy(tmp_path):
    old = io.BytesIO()
    savemat(old, {"t": np.arange(3.0)}, format="4")
    assert read(tmp_path, old.getvalue()).numbers("t", "here").tolist() == [0.0, 1.0, 2.0]


def test_a_big_endian_file_is_read(tmp_path):
    body = b"".join(
        [
            np.array([6, 8, 6, 0], ">u4").tobytes(),
            np.array([5, 8, 1, 2], ">i4").tobytes(),
            np.array([1 << 16 | 1], ">u4").tobytes() + b"t\0\0\0",
            np.array([9, 16], ">u4").tobytes() + np.array([1.0, 2.0], ">f8").tobytes(),
        ]
    )
    head = b"MATLAB 5.0".ljust(124) + b"\1\0MI"
    table = read(tmp_path, head + np.array([14, len(body)], ">u4").tobytes() + body)
    assert table.numbers("t", "here").tolist() == [1.0, 2.0]


@pytest.mark.parametrize("compressed", [False, True])
def test_any_damage_is_met_with_a_sentence(tmp_path: Path, compressed):
    """Some of it makes SciPy end the process where nobody looks before."""
    chance, whole = random.Random(1), packed(compressed)
    refused = 0
    for position in chance.choices(range(len(whole)), k=400):
        damaged = bytearray(whole)
        damaged[position] = chance.randrange(256)
        content = bytes(damaged[: chance.choice([len(damaged), len(damaged), position])])
        try:
            assert "t" in read(tmp_path, content).columns or position >= 128
        except DataError as error:
            assert str(error).startswith(f"here: {tmp_path / 'a.mat'} ")  # noqa: PT017
            refused += 1
    assert refused > 100


def test_the_data_of_numbers_must_have_the_size_that_its_dimensions_say(tmp_path):
    whole = packed()
    assert DIMENSIONS in whole
    wrong = whole.replace(DIMENSIONS, np.array([5, 8, 1, 6], "<i4").tobytes(), 1)
    with pytest.raises(DataError, match="a tag says 40 bytes of kind 9"):
        read(tmp_path, wrong)
