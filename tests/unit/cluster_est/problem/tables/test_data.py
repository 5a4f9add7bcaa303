import io
import random
import re
import struct
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pyarrow import feather
from scipy.io import savemat, whosmat

from cluster_est import read_table
from cluster_est.errors import DataError

TIMES = [0.0, 0.5, 1.0]
COLUMNS = {"t": TIMES, "y": [1.0, 2.0, 4.0]}


def text(folder, content, name="a.csv"):
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def numbers(path, column="t"):
    return read_table(path, "here").numbers(column, "here")


def refused(path, pattern, column="t"):
    with pytest.raises(DataError) as error:
        numbers(path, column)
    said = str(error.value)
    assert said.startswith("here: ")
    assert str(path) in said
    assert "\n" not in said
    assert re.search(pattern, said), said


def write(folder, table, ending):
    path = folder / f"a{ending}"
    writer = pq.write_table if ending == ".parquet" else feather.write_feather
    writer(table, path)
    return path


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
    path = text(tmp_path, content)
    for name, values in COLUMNS.items():
        np.testing.assert_array_equal(numbers(path, name), values)


@pytest.mark.parametrize("cell", ["", " ", "NaN", "nan", "NA", "N/A", "null"])
def test_an_empty_cell_is_not_measured(tmp_path, cell):
    path = text(tmp_path, f"t,y\n0,1\n0.5,{cell}\n1,4\n")
    np.testing.assert_array_equal(numbers(path, "y"), [1.0, np.nan, 4.0])


@pytest.mark.parametrize("delimiter", [",", ";"])
def test_true_and_false_are_1_and_0(tmp_path, delimiter):
    rows = "t,pump\n0,True\n0.5,False\n1,\n1.5,TRUE\n2,false \n".replace(",", delimiter)
    found = numbers(text(tmp_path, rows), "pump")
    np.testing.assert_array_equal(found, [1.0, 0.0, np.nan, 1.0, 0.0])


@pytest.mark.parametrize(
    ("content", "pattern"),
    [
        ("t,y\n0,1\n\n\n0.5x,2\n1,4\n", "column 't', row 5: .*a number.*'0.5x'; correct"),
        ("t,y\nTrue,1\nmaybe,2\n", "column 't', row 3: .*a number.*'maybe'; correct"),
        ("t;y\n0.5;1\n1,5;2\n", "column 't', row 3: .*a number.*'1,5'"),
        (f"t,y\n{'x' * 999},1\n", r"a number, but is 'xxxxx.*\.\.\."),
        ("s,y\n0,1\n", "a.csv has no column 't'.*'s', 'y'"),
        ("tt,(V),n\n0,1,2\n", r"a.csv has no column 't'.*'tt'.*columns are 'tt', '\(V\)', 'n'"),
        ("t,y,t\n0,1,2\n", "column 't': .*occur once, but 2 columns have that name; rename"),
        ("t,y\n0,1\n\n0.5\n", "2 cells in each row, as many as in its header, but row 4 has 1"),
        ("t,y\n0,1,\n0.5,2,\n", "2 cells in each row, as many as in its header, but row 2 has 3"),
        ("", "a header and rows of numbers, but is empty"),
        ("t,y", "a header and rows of numbers, but has only a header"),
        (b"t,\x81\n0,1\n", r"neither UTF-8 nor cp1252 \(byte 2\).*add encoding = "),
    ],
)
def test_a_bad_csv_is_refused_with_its_row(tmp_path, content, pattern):
    refused(text(tmp_path, content), pattern)


def test_a_long_file_names_its_first_bad_row(tmp_path):
    rows = [f"{i},1" for i in range(5000)]
    rows[3210] = rows[4000] = "x,1"
    refused(text(tmp_path, "\n".join(["t,y", *rows])), "row 3212: .*a number.*'x'")


@settings(max_examples=100)
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
        (pa.array(["0", "0,5", "1"]), TIMES),
        (pa.array(["0", "0.5", "1"]).dictionary_encode(), TIMES),
        (pa.array([0, 2**60 + 1, None]), [0, 2.0**60, np.nan]),
        (pa.array([0, None, 1], pa.decimal128(20, 2)), [0, np.nan, 1]),
        (pa.nulls(3), [np.nan] * 3),
        (pa.array([False, True, None]), [0, 1, np.nan]),
    ],
    ids=range(9),
)
@pytest.mark.parametrize("ending", [".parquet", ".feather"])
def test_columns_of_every_kind_of_number_are_read(tmp_path, times, expected, ending):
    np.testing.assert_array_equal(
        numbers(write(tmp_path, pa.table({"t": times}), ending)), expected
    )


@pytest.mark.parametrize(
    ("times", "pattern"),
    [
        (pa.array([1, 2, 3], pa.timestamp("ns")), r"numbers, but holds timestamp\[ns\]; con"),
        (pa.array([1, 2, 3], pa.duration("s")), r"numbers, but holds duration\[s\]"),
        (pa.array([1, 2, 3], pa.date32()), r"numbers, but holds date32\[day\]"),
        (pa.array([[1], [2], [3]]), "numbers, but holds list<"),
        (pa.array(["0", "one", "2"]), "column 't', row 2: .*a number.*'one'"),
        (
            pa.array(["1,500", "1", "2"]),
            "separator in '1,500' may be a decimal or a thousands sep.*decimal = ",
        ),
    ],
    ids=range(6),
)
def test_columns_without_numbers_are_refused(tmp_path, times, pattern):
    refused(write(tmp_path, pa.table({"t": times}), ".parquet"), pattern)


def test_a_repeated_column_of_a_parquet_is_refused_only_where_it_is_used(tmp_path):
    twice = pa.Table.from_arrays([pa.array(TIMES)] * 3, names=["t", "t", "y"])
    path = write(tmp_path, twice, ".parquet")
    refused(path, "occur once, but 2 columns")
    assert len(numbers(path, "y")) == 3


@pytest.mark.parametrize("ending", [".parquet", ".feather"])
def test_damaged_text_in_a_file_is_refused(tmp_path, ending):
    buffers = [None, pa.py_buffer(np.array([0, 1, 2, 3], np.int32)), pa.py_buffer(b"1\xff3")]
    bad = pa.Array.from_buffers(pa.string(), 3, buffers)
    refused(write(tmp_path, pa.table({"t": bad}), ending), "a readable .* file, but is not")


def test_a_folder_named_like_a_partition_adds_no_column(tmp_path):
    folder = tmp_path / "run=3"
    folder.mkdir()
    path = write(folder, pa.table(COLUMNS), ".parquet")
    assert list(read_table(path, "here").columns) == ["t", "y"]


MAT_73 = (
    b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H", 0x200) + b"IM" + b"\0" * 384
) + b"\x89HDF\r\n\x1a\n"


@pytest.mark.parametrize(
    ("content", "pattern"),
    [
        (MAT_73, "a readable mat file, but is not"),
        (b"", "a MAT file, but cannot be read as one"),
        (b"t,y\n0,1\n" * 50, "a MAT file, but cannot be read as one"),
    ],
)
def test_a_bad_mat_file_is_refused(tmp_path, content, pattern):
    refused(text(tmp_path, content, "a.mat"), pattern)


VECTORS = {
    "t": np.linspace(0.0, 1.0, 5),
    "count": np.arange(5, dtype=np.int8),
    "single": np.ones((3, 1), np.float32),
    "flags": np.array([True, False]),
    "nothing": np.zeros((0, 0)),
    "a_name_that_is_long_for_one": np.ones(2),
}
OTHERS = {
    "turned": (np.arange(5.0) + 1j, "5 complex128"),
    "table": (np.ones((2, 3, 2), np.uint16), "2 x 3 x 2 uint16"),
    "words": ("some text", "text"),
    "inner": (
        {"t": np.arange(3.0), "more": {"deep": np.ones(2), "no": "x"}},
        "a structure with t, more",
    ),
    "cells": (np.array([1.0, "a", np.arange(3)], dtype=object), "a cell array"),
}
FIELDS = {"inner.t": np.arange(3.0), "inner.more.deep": np.ones(2)}
DIMENSIONS = np.array([5, 8, 1, 5], "<i4").tobytes()


def packed(compressed=False):
    file = io.BytesIO()
    variables = VECTORS | {name: value for name, (value, _) in OTHERS.items()}
    savemat(file, variables, do_compression=compressed, long_field_names=True)
    return file.getvalue()


def read_mat(folder, content):
    return read_table(text(folder, content, "a.mat"), "here")


@pytest.mark.parametrize("compressed", [False, True])
def test_names_in_a_mat_file_are_those_that_scipy_finds(tmp_path, compressed):
    file = packed(compressed)
    table = read_mat(tmp_path, file)
    assert list(table.columns) == [*VECTORS, *FIELDS]
    for name, values in (VECTORS | FIELDS).items():
        np.testing.assert_array_equal(table.numbers(name, "here"), values.ravel())
    for name, (_, kind) in OTHERS.items():
        with pytest.raises(DataError, match=f"a.mat, column '{name}': .*a vector.*{kind}"):
            table.numbers(name, "here")
    assert {name for name, _, _ in whosmat(io.BytesIO(file))} == {*VECTORS, *OTHERS}


@pytest.mark.parametrize("compressed", [False, True])
def test_signals_in_structures_and_matrices_have_names(tmp_path, compressed):
    """A log as MATLAB saves it, with other kinds of fields beside the signals."""
    chance = np.random.default_rng(2)
    time, force, state = np.arange(5.0), chance.normal(size=5), chance.normal(size=(5, 2))
    log = {"time": time, "motor": {"force": force.astype(np.float32)}, "state": state}
    log |= {"note": "run 3", "nothing": np.zeros((0, 0)), "cells": np.array([1, "a"], object)}
    runs = np.array([({"t": 1},), ({"t": 2},)], dtype=[("s", object)])
    file = io.BytesIO()
    savemat(file, {"log": log, "wide": state.T, "runs": runs}, do_compression=compressed)
    table = read_mat(tmp_path, file.getvalue())
    expected = {"log.time": time, "log.motor.force": force.astype(np.float32)}
    expected |= {"log.state[0]": state[:, 0], "log.state[1]": state[:, 1]}
    expected |= {"wide[0]": state[:, 0], "wide[1]": state[:, 1]}
    for name, values in expected.items():
        np.testing.assert_array_equal(table.numbers(name, "here"), values)
    for name, said in {
        "log": "is a structure with time, motor, state, note, nothing, cells",
        "log.state": r"is 5 x 2 float64; name one of its signals, log.state\[0\] to log.state\[1\]",
        "runs": "is a structure of 1 x 2",
        "log.note": "is text of 1 x 5",
        "time": r"no column 'time'; did you mean 'log.time'\?",
    }.items():
        with pytest.raises(DataError, match=said):
            table.numbers(name, "here")


def test_a_mat_file_without_any_signal_says_what_it_has(tmp_path):
    file = io.BytesIO()
    savemat(file, {"words": "some text", "cells": np.array([1, "a"], object)})
    with pytest.raises(
        DataError, match=r"has no column 't'; 'words' must be.*'cells' must be.*cell"
    ):
        read_mat(tmp_path, file.getvalue()).numbers("t", "here")


def test_an_object_of_matlab_is_named_with_what_can_be_done(tmp_path):
    """A timeseries is saved in a form of MATLAB's own; other variables beside it are read."""
    texts = b"".join(
        np.array([1, len(text)], "<u4").tobytes() + text + bytes(-len(text) % 8)
        for text in (b"speed", b"MCOS", b"timeseries")
    )
    body = np.array([6, 8, 17, 0], "<u4").tobytes() + texts
    file = io.BytesIO()
    savemat(file, {"t": np.arange(3.0)})
    whole = file.getvalue() + np.array([14, len(body)], "<u4").tobytes() + body
    table = read_mat(tmp_path, whole)
    assert table.numbers("t", "here").tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(
        DataError, match=r"'speed': .*is a MATLAB object of class timeseries.*speed\.Time"
    ):
        table.numbers("speed", "here")


def test_a_mat_file_without_tags_is_left_to_scipy(tmp_path):
    old = io.BytesIO()
    savemat(old, {"t": np.arange(3.0)}, format="4")
    assert read_mat(tmp_path, old.getvalue()).numbers("t", "here").tolist() == [0.0, 1.0, 2.0]


def test_a_big_endian_mat_file_is_read(tmp_path):
    body = b"".join(
        [
            np.array([6, 8, 6, 0], ">u4").tobytes(),
            np.array([5, 8, 1, 2], ">i4").tobytes(),
            np.array([1 << 16 | 1], ">u4").tobytes() + b"t\0\0\0",
            np.array([9, 16], ">u4").tobytes() + np.array([1.0, 2.0], ">f8").tobytes(),
        ]
    )
    head = b"MATLAB 5.0".ljust(124) + b"\1\0MI"
    table = read_mat(tmp_path, head + np.array([14, len(body)], ">u4").tobytes() + body)
    assert table.numbers("t", "here").tolist() == [1.0, 2.0]


@pytest.mark.parametrize("compressed", [False, True])
def test_any_damage_of_a_mat_file_is_met_with_a_sentence(tmp_path, compressed):
    """Some of it makes SciPy end the process where nobody looks before."""
    chance, whole = random.Random(1), packed(compressed)
    refused = 0
    for position in chance.choices(range(len(whole)), k=400):
        damaged = bytearray(whole)
        damaged[position] = chance.randrange(256)
        content = bytes(damaged[: chance.choice([len(damaged), len(damaged), position])])
        try:
            assert "t" in read_mat(tmp_path, content).columns or position >= 128
        except DataError as error:
            assert str(error).startswith(f"here: {tmp_path / 'a.mat'} ")  # noqa: PT017
            refused += 1
    assert refused > 100


def test_the_data_of_a_mat_file_must_have_the_size_that_its_dimensions_say(tmp_path):
    whole = packed()
    assert DIMENSIONS in whole
    wrong = whole.replace(DIMENSIONS, np.array([5, 8, 1, 6], "<i4").tobytes(), 1)
    with pytest.raises(DataError, match="a tag says 40 bytes of kind 9"):
        read_mat(tmp_path, wrong)


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("a.parquet", "a readable parquet file, but is not"),
        ("a.feather", "a readable feather file, but is not"),
        ("a.xls", "end in one of .csv, .tsv, .txt"),
        ("a.xlsx", "a workbook, but cannot be read as one"),
        ("a.h5", "a readable HDF5 file, but is not"),
        ("a.mf4", "an MDF file, but cannot be read as one"),
        ("a.tdms", "a TDMS file( with channels)?, but"),
        ("a.fmu", "an FMU, but cannot be read as one"),
        ("a", "ends in ''; convert the file or rename it"),
    ],
)
@pytest.mark.parametrize("content", [b"", b"PAR1", b"t,y\n0,1\n" * 100])
def test_a_file_that_is_not_what_it_is_called_is_refused(tmp_path, name, pattern, content):
    refused(text(tmp_path, content, name), pattern)


@pytest.mark.parametrize("make", [lambda path: None, Path.mkdir])
@pytest.mark.parametrize("ending", [".csv", ".parquet", ".feather", ".mat"])
def test_a_file_that_is_not_there_is_refused(tmp_path, make, ending):
    path = tmp_path / f"a{ending}"
    make(path)
    refused(path, path.name)
