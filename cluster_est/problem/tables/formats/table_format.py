"""Base class for formats of measured files; a new format is a file here and a line in FORMATS."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

from cluster_est.errors import DataError
from cluster_est.plug_in import check_class_attributes
from cluster_est.problem.tables.measured_table import MeasuredTable, Reading


class TableFormat(ABC):
    """A format of files with measurements.

    Attributes
    ----------
    name
        Name of the format in messages.
    endings
        File extensions in lower case, with the point.
    keys
        Options of `Reading` that apply to the format.
    """

    name: ClassVar[str]
    endings: ClassVar[tuple[str, ...]]
    keys: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **more: object) -> None:
        super().__init_subclass__(**more)
        check_class_attributes(cls)

    @abstractmethod
    def read(self, path: Path, reading: Reading) -> MeasuredTable:
        """Read a file.

        Parameters
        ----------
        path
            Path of the file.
        reading
            The user's options.

        Raises
        ------
        DataError
            If the content is unsuitable; the caller adds the file's name to the message.
        ValueError, OSError
            If the file is damaged.
        """


def library(module: str, package: str, ending: str) -> Any:
    """Import the library that reads a format.

    Raises
    ------
    DataError
        If the library is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise DataError(
            f"is a {ending} file, which needs {package}, but {package} is missing; install it "
            'with: pip install "cluster-est[files]"'
        ) from None
