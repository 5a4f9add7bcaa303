"""MAT files: all numeric vectors, including those in structures and matrices."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.errors import DataError
from cluster_est.problem.tables.formats.arrays import clocks_in, columns_of
from cluster_est.problem.tables.formats.hdf5 import read_hdf5
from cluster_est.problem.tables.formats.table_format import TableFormat
from cluster_est.problem.tables.mat_file import contents
from cluster_est.problem.tables.measured_table import Column, MeasuredTable, Reading


class Mat(TableFormat):
    """MAT files of MATLAB, up to version 7 and, as HDF5, version 7.3."""

    name: ClassVar[str] = "mat"
    endings: ClassVar[tuple[str, ...]] = (".mat",)

    @override
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        from scipy.io import loadmat

        content = path.read_bytes()
        try:
            found = contents(content)
            wanted = None if found is None else found.numbers
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                variables = loadmat(io.BytesIO(content), squeeze_me=True, variable_names=wanted)
                if found is not None and found.fields:
                    variables |= loadmat(io.BytesIO(found.fields), squeeze_me=True)
        except NotImplementedError:
            return read_hdf5(path, matlab=True)
        except OSError:
            raise
        except Exception as error:  # SciPy raises various exceptions for damaged files
            raise DataError(
                f"must be a MAT file, but cannot be read as one ({type(error).__name__}: {error}); "
                "save it again"
            ) from error
        columns: dict[str, Column] = {}
        others = {} if found is None else found.others
        unusable = {
            name: f"must be a vector of numbers, but is {it}" for name, it in others.items()
        }
        for name, values in variables.items():
            if name.startswith("__") and not isinstance(values, np.ndarray):
                continue
            for own, column in columns_of(name, values):
                if isinstance(column, str):
                    unusable[own] = column
                else:
                    columns[own] = column
        return MeasuredTable(path, columns, unusable, clocks=clocks_in(columns, "."))
