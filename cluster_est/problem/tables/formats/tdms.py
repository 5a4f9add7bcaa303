"""TDMS, the format of LabVIEW, with npTDMS.

A waveform channel has its own times, given by the increment between samples. For other channels,
the group has a channel with the times.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.errors import DataError
from cluster_est.problem.tables.formats.arrays import Clocks, columns_of
from cluster_est.problem.tables.formats.table_format import TableFormat, library
from cluster_est.problem.tables.measured_table import Column, MeasuredTable, Reading
from workers.messages import FloatArray


class Tdms(TableFormat):
    """TDMS files, with channels in groups."""

    name: ClassVar[str] = "TDMS"
    endings: ClassVar[tuple[str, ...]] = (".tdms",)

    @override
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        nptdms = library("nptdms", "npTDMS", path.suffix)
        try:
            opened = nptdms.TdmsFile.read(path)
        except OSError:
            raise
        except Exception as error:  # npTDMS raises various exceptions
            raise DataError(
                f"must be a TDMS file, but cannot be read as one ({type(error).__name__}: "
                f"{error}); check that it is complete, or save it again"
            ) from error
        groups = opened.groups()
        if not any(group.channels() for group in groups):
            raise DataError("must be a TDMS file with channels, but has none; check the file")
        first = _first_start(groups)
        columns: dict[str, Column] = {}
        unusable: dict[str, str] = {}
        units: dict[str, str] = {}
        clocks = Clocks()
        for group in groups:
            for channel in group.channels():
                name = channel.name if len(groups) == 1 else f"{group.name}/{channel.name}"
                times = _times(channel, first)
                for own, column in columns_of(name, channel[:]):
                    if isinstance(column, str):
                        unusable[own] = column
                        continue
                    columns[own] = column
                    if times is not None:
                        clocks.add(own, name, times)
                    if channel.properties.get("unit_string"):
                        units[own] = str(channel.properties["unit_string"])
        return clocks.table(path, columns, unusable, units)


def _first_start(groups: Any) -> Any:
    """Return the earliest start time of the waveforms; None if none is given."""
    starts = [
        channel.properties["wf_start_time"]
        for group in groups
        for channel in group.channels()
        if _is_waveform(channel) and "wf_start_time" in channel.properties
    ]
    return min(starts, default=None)


def _is_waveform(channel: Any) -> bool:
    return len(channel) > 0 and float(channel.properties.get("wf_increment", 0.0)) > 0.0


def _times(channel: Any, first: Any) -> FloatArray | None:
    """Return the times of a waveform in seconds since the first start; None for other channels."""
    if not _is_waveform(channel):
        return None
    own = channel.properties
    late = 0.0
    if first is not None and "wf_start_time" in own:
        late = float((own["wf_start_time"] - first) / np.timedelta64(1, "ns")) * 1e-9
    offset = float(own.get("wf_start_offset", 0.0)) + late
    return np.asarray(offset + np.arange(len(channel)) * float(own["wf_increment"]), np.float64)
