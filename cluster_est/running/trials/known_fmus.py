"""The FMUs that this machine knows: what was tried with them in a process of their own."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

from workers.fmu.archive import unpacked_folder
from workers.messages import Experiment, Model, Task, content_hash


@dataclass(frozen=True)
class Trial:
    """Some simulations of an FMU, and what they are to show.

    Another value of a parameter, of an experiment or of the solver's settings makes another trial:
    an FMU may crash with one and not with the other.

    Attributes
    ----------
    shows
        It has "survived" if it was simulated, reset and simulated again without a crash; it was
        "undisturbed" if two instances at once gave what one alone gives.
    model, experiments, tasks
        The simulations.
    """

    shows: Literal["survived", "undisturbed"]
    model: Model
    experiments: Sequence[Experiment] = field(repr=False)
    tasks: Sequence[Task] = field(repr=False)

    @property
    def passed(self) -> bool:
        """True if that was shown here before."""
        return self._mark.exists()

    def remember(self) -> None:
        """Remember that; where it cannot be written down, the FMU is tried again the next time."""
        with contextlib.suppress(OSError):
            self._mark.touch()

    @cached_property
    def _mark(self) -> Path:
        """A file beside the unpacked FMU, named after all that was simulated."""
        parts: list[str | bytes] = [self.model.key]
        for task in self.tasks:
            experiment = self.experiments[task.experiment]
            parts += [task.values.tobytes(), repr((experiment.start, experiment.stop))]
            parts += [repr(experiment.values)]  # what was measured does not matter
            for given in experiment.inputs:
                parts += [given.variable, given.interpolation]
                parts += [given.times.tobytes(), given.values.tobytes()]
        folder = unpacked_folder(self.model.archive_hash)
        return folder.with_name(f"{folder.name}.{self.shows}-{content_hash(parts)[:32]}")
