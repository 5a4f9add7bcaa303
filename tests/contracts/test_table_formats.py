"""What every format of measured files must do. A new one is picked up by its line in FORMATS."""

import importlib
import inspect
import pkgutil

import numpy as np
import pytest
from support.logger_files import CASES, fmu_with_references

from cluster_est.errors import DataError
from cluster_est.problem.tables import formats
from cluster_est.problem.tables.files import format_of, read_table
from cluster_est.problem.tables.formats import FORMATS, TableFormat
from cluster_est.problem.tables.measured_table import Reading

EVERY = pytest.mark.parametrize("kind", FORMATS, ids=lambda each: each.name)
EXTRA = ("asammdf", "h5py", "nptdms", "openpyxl")
"""Libraries of cluster-est[files]."""


def example(kind, folder):
    """A file of the format, with times, forces and positions in it."""
    if ".fmu" in kind.endings:
        return fmu_with_references(folder)
    plain = (each for each in CASES if not (each.refused or each.edit or each.read))
    for each in plain:
        inner = folder / str(len(list(folder.iterdir())))
        inner.mkdir()
        path = each.make(inner)
        if format_of(path) is kind:
            return path
    raise AssertionError(f"add a file of {kind.name} to CASES in tests/support/logger_files.py")


def test_every_format_that_is_written_is_registered():
    for module in pkgutil.iter_modules(formats.__path__):
        importlib.import_module(f"{formats.__name__}.{module.name}")
    known = {type(each) for each in FORMATS}
    written = {each for each in TableFormat.__subclasses__() if not inspect.isabstract(each)}
    assert {each for each in written if each.__module__.startswith("cluster_est")} == known


def test_no_two_formats_have_the_same_ending():
    endings = [ending for each in FORMATS for ending in each.endings]
    assert len(set(endings)) == len(endings)
    assert all(ending.startswith(".") and ending == ending.lower() for ending in endings)


@EVERY
def test_its_keys_are_keys_of_a_reading(kind):
    assert set(kind.keys) <= set(vars(Reading()))


@EVERY
def test_the_same_file_gives_the_same_table_with_columns_of_numbers(kind, tmp_path):
    path = example(kind, tmp_path)
    one, other = read_table(path), read_table(path)
    assert one == other
    assert len(one.columns) >= 2
    numeric = [name for name in one.columns if "time" not in name.casefold()]
    assert any(np.isfinite(one.numbers(name, "here")).all() for name in numeric)
    assert set(one.clocks) | set(one.clocks.values()) | set(one.units) <= set(one.columns)


@EVERY
@pytest.mark.parametrize("content", [b"", b"\0" * 64, b"no table at all, by no means\n" * 3])
def test_a_file_that_is_none_is_refused_in_one_sentence(kind, content, tmp_path):
    path = tmp_path / f"a{kind.endings[0]}"
    path.write_bytes(content)
    with pytest.raises(DataError) as error:
        read_table(path, "here").numbers("y", "here")
    assert str(error.value).startswith(f"here: {path}")
    assert "\n" not in str(error.value)


@EVERY
def test_a_file_that_is_not_there_is_said(kind, tmp_path):
    with pytest.raises(DataError, match=r"here: .*(there is no file|cannot be read)"):
        read_table(tmp_path / f"a{kind.endings[0]}", "here")


@EVERY
def test_a_library_that_is_missing_is_named_with_what_installs_it(kind, tmp_path, monkeypatch):
    path, real = example(kind, tmp_path), importlib.import_module

    def without(name, *more):
        if name.split(".")[0] in EXTRA:
            raise ImportError(name)
        return real(name, *more)

    monkeypatch.setattr(importlib, "import_module", without)
    try:
        read_table(path, "here")
    except DataError as error:
        assert 'pip install "cluster-est[files]"' in str(error)  # noqa: PT017
