"""Formats of files with measurements. A new format is a file here and a line in FORMATS."""

from cluster_est.problem.tables.formats.arrow_files import Feather, Parquet
from cluster_est.problem.tables.formats.delimited import DelimitedText
from cluster_est.problem.tables.formats.fmu_references import FmuReferences
from cluster_est.problem.tables.formats.hdf5 import Hdf5
from cluster_est.problem.tables.formats.mat import Mat
from cluster_est.problem.tables.formats.mdf import Mdf
from cluster_est.problem.tables.formats.table_format import TableFormat
from cluster_est.problem.tables.formats.tdms import Tdms
from cluster_est.problem.tables.formats.workbook import Workbook

__all__ = ["ENDINGS", "FORMATS", "TableFormat"]

FORMATS: tuple[TableFormat, ...] = (
    DelimitedText(),
    Parquet(),
    Feather(),
    Mat(),
    Hdf5(),
    Mdf(),
    Tdms(),
    Workbook(),
    FmuReferences(),
)
ENDINGS = {ending: each for each in FORMATS for ending in each.endings}
"""Formats by file extension."""
