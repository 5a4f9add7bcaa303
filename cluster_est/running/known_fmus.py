"""The FMUs that this machine knows: what was tried with them in a process of their own."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from workers.fmu.archive import unpacked_folder
from workers.messages import Experiment, Model, Task, content_hash

Trial = Literal["survived", "undisturbed"]
"""It was simulated, reset and simulated again without a crash; two instances at once were right."""


def has_passed(
    trial: Trial, model: Model, experiments: Sequence[Experiment], tasks: Sequence[Task]
) -> bool:
    """Return whether this FMU has passed a trial here, with the same simulations.

    Parameters
    ----------
    trial
        What was tried.
    model, experiments, tasks
        The simulations. Another value of a parameter, of an experiment or of the solver's settings
        is another trial: an FMU may crash with one and not with the other.
    """
    return _mark(trial, model, experiments, tasks).exists()


def remember_pass(
    trial: Trial, model: Model, experiments: Sequence[Experiment], tasks: Sequence[Task]
) -> None:
    """Remember that; where it cannot be written down, the FMU is tried again the next time."""
    with contextlib.suppress(OSError):
        _mark(trial, model, experiments, tasks).touch()


def _mark(
    trial: Trial, model: Model, experiments: Sequence[Experiment], tasks: Sequence[Task]
) -> Path:
    """Return a file beside the unpacked FMU, named after all that was simulated."""
    parts: list[str | bytes] = [model.key]
    for task in tasks:
        experiment = experiments[task.experiment]
        parts += [task.values.tobytes(), repr((experiment.start, experiment.stop))]
        parts += [repr(experiment.values)]  # what was measured does not matter
        for given in experiment.inputs:
            parts += [given.variable, given.interpolation]
            parts += [given.times.tobytes(), given.values.tobytes()]
    folder = unpacked_folder(model.archive_hash)
    return folder.with_name(f"{folder.name}.{trial}-{content_hash(parts)[:32]}")
