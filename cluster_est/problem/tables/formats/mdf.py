"""MDF, the measurement data format of ASAM (versions 3 and 4), with asammdf.

The channels of a group share the times in its master channel. Each group has its own rate.
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.errors import DataError
from cluster_est.problem.tables.formats.arrays import Clocks, columns_of
from cluster_est.problem.tables.formats.table_format import TableFormat, library
from cluster_est.problem.tables.measured_table import Column, MeasuredTable, Reading


class Mdf(TableFormat):
    """MDF files of versions 3 and 4."""

    name: ClassVar[str] = "MDF"
    endings: ClassVar[tuple[str, ...]] = (".mf4", ".mdf", ".mf3")

    @override
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        asammdf = library("asammdf", "asammdf", path.suffix)
        logging.getLogger("asammdf").setLevel(logging.ERROR)
        try:
            with asammdf.MDF(path) as opened:
                signals = list(_signals(opened))
        except OSError:
            raise
        except Exception as error:  # asammdf raises various exceptions
            raise DataError(
                f"must be an MDF file, but cannot be read as one ({type(error).__name__}: "
                f"{error}); check that it is complete, or save it again"
            ) from error
        counts = Counter(signal.name for _, signal in signals)
        clocks = Clocks()
        columns: dict[str, Column] = {}
        unusable: dict[str, str] = {}
        units: dict[str, str] = {}
        for group, signal in signals:
            name = signal.name if counts[signal.name] == 1 else f"{group}/{signal.name}"
            for own, column in columns_of(name, _samples(signal)):
                if isinstance(column, str):
                    unusable[own] = column
                    continue
                columns[own] = column
                clocks.add(own, group, np.asarray(signal.timestamps, np.float64))
                if signal.unit:
                    units[own] = str(signal.unit)
        return clocks.table(path, columns, unusable, units)


def _signals(opened: Any) -> Any:
    """Yield all channels except the times, with the number of their group."""
    for number, group in enumerate(opened.groups):
        master = opened.masters_db.get(number)
        for index, _ in enumerate(group.channels):
            if index != master:
                yield number, opened.get(group=number, index=index)


def _samples(signal: Any) -> Any:
    """Return the samples of a channel; NaN for samples that are marked as invalid."""
    values = signal.samples
    invalid = signal.invalidation_bits
    if invalid is None or values.ndim != 1 or values.dtype.kind not in "fiub":
        return values
    return np.where(np.asarray(invalid, bool), np.nan, values.astype(np.float64))
