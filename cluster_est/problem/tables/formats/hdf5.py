"""HDF5 files, with h5py: all vectors of numbers, times or texts, named by their groups.

MAT files of version 7.3 are HDF5 files. MATLAB stores arrays with reversed dimensions and text as
character codes. Its objects (timeseries, tables, datetimes) have an undocumented format, which is
not read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
from typing_extensions import override

from cluster_est.errors import DataError
from cluster_est.problem.tables.formats.arrays import clocks_in, columns_of
from cluster_est.problem.tables.formats.table_format import TableFormat, library
from cluster_est.problem.tables.mat_file import object_of_matlab
from cluster_est.problem.tables.measured_table import Column, MeasuredTable, Reading

UNITS: Final = ("unit", "units", "Unit", "Units", "unit_string")
"""Attributes of a dataset that contain its unit."""
NUMERIC_CLASSES: Final = (
    "double", "single", "logical",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)  # fmt: skip
"""Numeric classes of MATLAB."""


class Hdf5(TableFormat):
    """HDF5 files of any program."""

    name: ClassVar[str] = "HDF5"
    endings: ClassVar[tuple[str, ...]] = (".h5", ".hdf5", ".hdf")

    @override
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        return read_hdf5(path, matlab=False)


def read_hdf5(path: Path, *, matlab: bool) -> MeasuredTable:
    """Read all datasets of a file.

    Parameters
    ----------
    path
        Path of the file.
    matlab
        Whether the file is a MAT file.

    Raises
    ------
    DataError
        If h5py is not installed.
    OSError
        If the file is not an HDF5 file.
    """
    h5py = library("h5py", "h5py", "MAT 7.3" if matlab else path.suffix)
    columns: dict[str, Column] = {}
    unusable: dict[str, str] = {}
    units: dict[str, str] = {}

    def take(name: str, node: Any) -> None:
        name = name.replace("/", "." if matlab else "/")
        if matlab and name.startswith("#"):
            return
        kind = _text(node.attrs.get("MATLAB_class", b"")) if matlab else ""
        if not isinstance(node, h5py.Dataset):
            return
        if matlab and kind not in NUMERIC_CLASSES:
            unusable[name] = f"must be a vector of numbers, but is {_called(name, kind)}"
            return
        values = np.asarray(node[()])
        if matlab:
            values = np.squeeze(values.T) if values.size else np.zeros(0)
        values = _scaled(values, node.attrs)
        unit = next((_text(node.attrs[key]) for key in UNITS if key in node.attrs), "")
        for own, column in columns_of(name, values):
            if isinstance(column, str):
                unusable[own] = column
            else:
                columns[own] = column
                if unit:
                    units[own] = unit

    with h5py.File(path, "r") as opened:
        opened.visititems(take)
    if not columns and not unusable:
        raise DataError("must have data sets, but has none; check the file")
    clocks = clocks_in(columns, ".") | ({} if matlab else clocks_in(columns, "/"))
    return MeasuredTable(path, columns, unusable, units=units, clocks=clocks)


def _scaled(values: Any, attributes: Any) -> Any:
    """Return numbers unpacked with netCDF's scale, offset and fill values."""
    if values.dtype.kind not in "iuf":
        return values
    packed = [key for key in ("scale_factor", "add_offset") if key in attributes]
    fills = [
        np.ravel(attributes[key]) for key in ("_FillValue", "missing_value") if key in attributes
    ]
    if not packed and not fills:
        return values
    found = values.astype(np.float64)
    for fill in fills:
        found[np.isin(values, fill)] = np.nan
    scale = float(np.ravel(attributes.get("scale_factor", 1.0))[0])
    return found * scale + float(np.ravel(attributes.get("add_offset", 0.0))[0])


def _called(name: str, kind: str) -> str:
    """Return a description of a MATLAB class, with advice for objects."""
    usual = {"char": "text", "cell": "a cell array", "": "not of a MATLAB class"}
    return usual[kind] if kind in usual else object_of_matlab(name, kind)


def _text(value: Any) -> str:
    value = value[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
