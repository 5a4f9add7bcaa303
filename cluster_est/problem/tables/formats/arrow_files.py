"""Parquet and Feather files."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import pyarrow.parquet as pq
from pyarrow import feather
from typing_extensions import override

from cluster_est.problem.tables.formats.table_format import TableFormat
from cluster_est.problem.tables.measured_table import MeasuredTable, Reading, named_columns


class Parquet(TableFormat):
    """Apache Parquet."""

    name: ClassVar[str] = "parquet"
    endings: ClassVar[tuple[str, ...]] = (".parquet", ".pq")
    keys: ClassVar[tuple[str, ...]] = ("decimal",)

    @override
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        # read_table would make a column from a folder name such as "run=3"
        with pq.ParquetFile(path, page_checksum_verification=True) as opened:
            table = opened.read()
        table.validate(full=True)
        return named_columns(path, table)


class Feather(TableFormat):
    """Feather, the Arrow file format."""

    name: ClassVar[str] = "feather"
    endings: ClassVar[tuple[str, ...]] = (".feather", ".arrow", ".ipc")
    keys: ClassVar[tuple[str, ...]] = ("decimal",)

    @override
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        table = feather.read_table(path, memory_map=False)
        table.validate(full=True)
        return named_columns(path, table)
