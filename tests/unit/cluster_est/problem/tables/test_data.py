"""Measured tables: what must work, and what is refused with its place and a sentence."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pyarrow import feather
from scipy.io import savemat

from cluster_est.errors import DataError
from cluster_est.problem.tables.files import read_table

TIMES = [0.0, 0.5, 1.0]
COLUMNS = {"t": TIMES, "y": [1.0, 2.0, 4.0]}


def text(folder: Path, content: str | bytes, name: str = "a.csv") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refusal(path: Path, column: str = "t") -> str:
    with pytest.raises(DataError) as error:
        read_table(path, "here").numbers(column, "here")
    message = str(error.value)
    assert message.startswith("here: ")
    assert str(path) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    "content",
    [
        "t,y\n0,1\n.5,2\n1e0,4\n",
        "t,y\r\n0,1\r\n0.5,2\r\n1,4",
        "\n\nt, y\n0,1\n\n +0.5 ,2\n1,4\n\n",
        "\ufefft,y\n0,1\n0.5,2\n1,4\n",
        "t;y\n0;1\n0,5;2\n1;4\n",
        "t;y\n0;1\n0.5;2\n1;4\n",
        "t\ty\n0\t1\n0,5\t2\n1\t4\n",
        "t,y,\n0,1,\n0.5,2,\n1,4,\n",
        't,y,note\n0,1,"a, b"\n0.5,2,\n1,4,c\n',
        "t,y,z,z\n0,1,0,0\n0.5,2,0,0\n1,4,0,0\n",
    ],
)
def test_every_usual_csv_is_read(tmp_path, content):
    table = read_table(text(tmp_path, content), "here")
    for name, values in COLUMNS.items():
        np.testing.assert_array_equal(table.numbers(name, "here"), values)


@pytest.mark.parametrize("cell", ["", " ", "NaN", "nan", "NA", "N/A", "null"])
def test_an_empty_cell_is_not_measured(tmp_path, cell):
    table = read_table(text(tmp_path, f"t,y\n0,1\n0.5,{cell}\n1,4\n"), "here")
    np.testing.assert_array_equal(table.numbers("y", "here"), [1.0, np.nan, 4.0])


@pytest.mark.parametrize("delimiter", [",", ";"])
def test_true_and_false_are_1_and_0(tmp_path, delimiter):
    rows = "t,pump\n0,True\n0.5,False\n1,\n1.5,TRUE\n2,false \n".replace(",", delimiter)
    table = read_table(text(tmp_path, rows), "here")
    np.testing.assert_array_equal(table.numbers("pump", "here"), [1.0, 0.0, np.nan, 1.0, 0.0])


@pytest.mark.parametrize("ending", [".parquet", ".feather"])
def test_true_and_false_of_a_binary_table_too(tmp_path, ending):
    path = write(tmp_path, pa.table({"t": [0.0, 1.0], "pump": [True, None]}), ending)
    np.testing.assert_array_equal(read_table(path, "x").numbers("pump", "x"), [1.0, np.nan])


def test_a_column_that_is_not_there_is_answered_with_those_that_are(tmp_path):
    message = refusal(text(tmp_path, "Zeit,Voltage (V),n\n0,1,2\n"), "Voltage")
    assert message.endswith(
        "a.csv has no column 'Voltage'; did you mean 'Voltage (V)'? Its columns are 'Zeit', "
        "'Voltage (V)', 'n'"
    )


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("t,y\n0,1\n\n\n0.5x,2\n1,4\n", "column 't', row 5: must be a number but is '0.5x'; mend"),
        ("t,y\n0,1\n1 000,2\n", "column 't', row 3: must be a number but is '1 000'"),
        ("t,y\nTrue,1\nmaybe,2\n", "column 't', row 3: must be a number but is 'maybe'; mend"),
        ("t;y\n0.5;1\n1,5;2\n", "column 't', row 3: must be a number but is '1,5'"),
        (f"t,y\n{'x' * 999},1\n", "must be a number but is 'xxxxx"),
        ("s,y\n0,1\n", "has no column 't'; it has 's', 'y'"),
        ("tt,y\n0,1\n", "has no column 't'; did you mean 'tt'?"),
        ("t,y,t\n0,1,2\n", "column 't': must be there once but 2 columns have that name; rename"),
        ("t,y, t\n0,1,2\n", "column 't': must be there once but 2 columns have that name"),
        ("t,y\n0,1\n\n0.5\n", "as many cells in each row as in its header, 2, but row 4 has 1"),
        ("t,y\n0,1,\n0.5,2,\n", "as many cells in each row as in its header, 2, but row 2 has 3"),
        ("", "must have a header and rows of numbers but has nothing in it"),
        ("\n\n", "must have a header and rows of numbers but has nothing in it"),
        ("t,y", "must have a header and rows of numbers but has only a header"),
        ("t,y\n0,1\n0.5,é\n".encode("latin-1"), "must be text in UTF-8 but row 3 is not; save it"),
        ("é,y\n0,1\n".encode("latin-1"), "must be text in UTF-8 but row 1 is not"),
        ("t,y\n0,1\n".encode("utf-16"), "must be text in UTF-8 but row 1 is not"),
    ],
)
def test_a_bad_csv_is_refused_with_its_row(tmp_path, content, sentence):
    assert sentence in refusal(text(tmp_path, content))


def test_a_long_file_names_its_first_bad_row(tmp_path):
    rows = [f"{i},1" for i in range(5000)]
    rows[3210] = rows[4000] = "x,1"
    message = refusal(text(tmp_path, "\n".join(["t,y", *rows])))
    assert "row 3212: must be a number but is 'x'" in message


@settings(max_examples=200)
@given(st.one_of(st.binary(max_size=80), st.text(alphabet='t,;\t\n\r "0.5eé-x', max_size=60)))
@example(b"\0" * 50)
@example(b'"')
def test_any_bytes_are_read_or_refused(tmp_path_factory, content):
    path = text(tmp_path_factory.getbasetemp(), content, "any.csv")
    try:
        table = read_table(path, "here")
        for name in [*table.columns, "no"]:
            table.numbers(name, "here")
    except DataError as error:
        assert str(error).startswith(f"here: {path}")  # noqa: PT017


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        (pa.array([0, 1, 2]), [0, 1, 2]),
        (pa.array([0, 0.5, 1], pa.float32()), TIMES),
        (pa.array(["0", " 0.5", "1"]), TIMES),
        (pa.array(["0", "0.5", "1"]).dictionary_encode(), TIMES),
        (pa.array([0, 2**60 + 1, None]), [0, 2.0**60, np.nan]),
        (pa.array([0, None, 1], pa.decimal128(20, 2)), [0, np.nan, 1]),
        (pa.nulls(3), [np.nan] * 3),
        (pa.array([False, True, None]), [0, 1, np.nan]),
    ],
)
@pytest.mark.parametrize("ending", [".parquet", ".feather"])
def test_columns_of_every_kind_of_number_are_read(tmp_path, times, expected, ending):
    path = write(tmp_path, pa.table({"t": times}), ending)
    np.testing.assert_array_equal(read_table(path, "here").numbers("t", "here"), expected)


@pytest.mark.parametrize(
    ("times", "sentence"),
    [
        (pa.array([1, 2, 3], pa.timestamp("ns")), "must hold numbers but holds timestamp[ns]; con"),
        (pa.array([1, 2, 3], pa.duration("s")), "must hold numbers but holds duration[s]"),
        (pa.array([1, 2, 3], pa.date32()), "must hold numbers but holds date32[day]"),
        (pa.array([[1], [2], [3]]), "must hold numbers but holds list<"),
        (pa.array(["0", "one", "2"]), "column 't', row 2: must be a number but is 'one'"),
        (pa.array(["0,5", "1", "2"]), "column 't', row 1: must be a number but is '0,5'"),
    ],
)
def test_columns_without_numbers_are_refused(tmp_path, times, sentence):
    assert sentence in refusal(write(tmp_path, pa.table({"t": times}), ".parquet"))


def write(folder: Path, table: pa.Table, ending: str) -> Path:
    path = folder / f"a{ending}"
    writer = pq.write_table if ending == ".parquet" else feather.write_feather
    writer(table, path)
    return path


def test_a_repeated_column_of_a_parquet_is_refused_only_where_it_is_used(tmp_path):
    twice = pa.Table.from_arrays([pa.array(TIMES)] * 3, names=["t", "t", "y"])
    path = write(tmp_path, twice, ".parquet")
    assert "must be there once but 2 columns" in refusal(path)
    assert len(read_table(path, "here").numbers("y", "here")) == 3


@pytest.mark.parametrize("ending", [".parquet", ".feather"])
def test_damaged_text_in_a_file_is_refused(tmp_path, ending):
    buffers = [None, pa.py_buffer(np.array([0, 1, 2, 3], np.int32)), pa.py_buffer(b"1\xff3")]
    bad = pa.Array.from_buffers(pa.string(), 3, buffers)
    message = refusal(write(tmp_path, pa.table({"t": bad}), ending))
    assert "that can be read but is not" in message


def test_a_folder_named_like_a_partition_adds_no_column(tmp_path):
    folder = tmp_path / "run=3"
    folder.mkdir()
    path = write(folder, pa.table(COLUMNS), ".parquet")
    assert list(read_table(path, "here").columns) == ["t", "y"]


@pytest.mark.parametrize("shape", [(3,), (1, 3), (3, 1)])
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int16, bool])
def test_vectors_of_a_mat_file_are_read(tmp_path, shape, kind):
    values = np.array([0, 1, 1], kind)
    savemat(tmp_path / "a.mat", {"t": values.reshape(shape), "m": np.ones((2, 2)), "s": "text"})
    read = read_table(tmp_path / "a.mat", "here").numbers("t", "here")
    assert read.dtype == np.float64
    np.testing.assert_array_equal(read, [0, 1, 1])


MAT_73 = (
    b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H", 0x200) + b"IM" + b"\0" * 384
) + b"\x89HDF\r\n\x1a\n"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({"t": np.ones((3, 4))}, "column 't': must be a vector of numbers but is 3 x 4 float64"),
        ({"t": "text"}, "column 't': must be a vector of numbers but is text"),
        ({"t": np.array([1j, 2.0])}, "must be a vector of numbers but is 2 complex128"),
        ({"run": {"t": np.ones(3)}}, "has no column 't'"),
        (MAT_73, 'but is of version 7.3, which is HDF5; save it with save(..., "-v7")'),
        (b"", "must be a MAT file but cannot be read as one"),
        (b"t,y\n0,1\n" * 50, "must be a MAT file but cannot be read as one"),
    ],
)
def test_a_bad_mat_file_is_refused(tmp_path, content: Any, sentence):
    path = tmp_path / "a.mat"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        savemat(path, content)
    assert sentence in refusal(path)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("a.parquet", "must be a parquet file that can be read but is not"),
        ("a.feather", "must be a feather file that can be read but is not"),
        ("a.xlsx", "must end in one of .csv, .tsv, .txt, .parquet"),
        ("a", "but ends in ''; convert it or rename it"),
    ],
)
@pytest.mark.parametrize("content", [b"", b"PAR1", b"t,y\n0,1\n" * 100])
def test_a_file_that_is_not_what_it_is_called_is_refused(tmp_path, name, sentence, content):
    assert sentence in refusal(text(tmp_path, content, name))


@pytest.mark.parametrize("make", [lambda path: None, Path.mkdir])
@pytest.mark.parametrize("ending", [".csv", ".parquet", ".feather", ".mat"])
def test_a_file_that_is_not_there_is_refused(tmp_path, make: Callable[[Path], object], ending: str):
    path = tmp_path / f"a{ending}"
    make(path)
    assert path.name in refusal(path)
