"""What a format of measured files is; a new one is a file beside this one, a line in FORMATS."""

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
        Of the format, in messages.
    endings
        Of its files, in small letters, with the point.
    keys
        Keys of `Reading` that mean something to it.
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
            Of the file.
        reading
            What the user says of it.

        Raises
        ------
        DataError
            With what it must be, what it is and what to do; the file is named by who called.
        ValueError, OSError
            If it is damaged.
        """


def library(module: str, package: str, ending: str) -> Any:
    """Import the library that a format is read with.

    Raises
    ------
    DataError
        If it is not installed, with the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise DataError(
            f"is a {ending} file, which needs {package}, but {package} is missing; install it "
            'with: pip install "cluster-est[files]"'
        ) from None
