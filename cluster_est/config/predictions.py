"""What a file of limits, or the command line, wants to be predicted."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from cluster_est.config.sections.design import PredictionSection
from cluster_est.errors import ConfigError, ProblemError
from cluster_est.experiment_design.settings import DesignSettings
from cluster_est.experiment_design.targets import PredictionTarget
from cluster_est.problem.tables.files import read_table
from workers.messages import Experiment, Input

OPTION = "--predict"


def prediction_targets(
    sections: Sequence[PredictionSection], base: Path
) -> tuple[PredictionTarget, ...]:
    """Return the targets of a file of limits.

    Parameters
    ----------
    sections
        Of the file.
    base
        Its folder, from which paths of tables start.

    Raises
    ------
    ClusterEstError
        If a section names both an experiment and a table, or a table cannot be read.
    """
    return tuple(
        PredictionTarget(_experiment(each, f"predictions[{i}]", base), tuple(each.outputs))
        for i, each in enumerate(sections)
    )


def _experiment(section: PredictionSection, where: str, base: Path) -> str | Experiment:
    """The name of an experiment of the run, or one that is planned."""
    if not section.data:
        for key in ("inputs", "time", "interpolation"):
            if key in section.model_fields_set:
                raise ConfigError(
                    f"{where}.{key}: must stand beside data, the table of a planned experiment, "
                    "but there is none; add data or remove it"
                )
        return section.experiment
    if section.experiment:
        raise ConfigError(
            f"{where}.data: must be left out where an experiment of the run is named, but is "
            f"{section.data!r}; remove one of the two"
        )
    table = read_table(base / section.data, f"{where}.data")
    times = table.numbers(section.time, f"{where}.time")
    columns = section.inputs or {name: name for name in table.columns if name != section.time}
    inputs = tuple(
        Input(name, times, table.numbers(column, f"{where}.inputs.{name}"), section.interpolation)
        for name, column in columns.items()
    )
    if not inputs or len(times) < 2:
        raise ConfigError(
            f"{where}.data: {section.data} must have a column for an input, and two rows at least, "
            f"but has {len(columns)} and {len(times)}"
        )
    name = Path(section.data).stem
    return Experiment(name, float(times[0]), float(times[-1]), inputs, ())


def with_named_targets(
    settings: DesignSettings, named: Sequence[str], experiments: Collection[str]
) -> DesignSettings:
    """Return settings that narrow what the command line names, in the place of the file's.

    Parameters
    ----------
    settings
        Of the file of limits.
    named
        "EXPERIMENT" or "EXPERIMENT:OUTPUT,OUTPUT".
    experiments
        Names of the run's.

    Raises
    ------
    ConfigError
        If the file asks for another criterion.
    """
    if not named:
        return settings
    targets = []
    for text in named:
        name, outputs = text, ""
        if text not in experiments and ":" in text:
            name, _, outputs = text.rpartition(":")
        targets.append(
            PredictionTarget(name, tuple(o.strip() for o in outputs.split(",") if o.strip()))
        )
    try:
        return replace(settings, predictions=tuple(targets))
    except ProblemError as error:
        raise ConfigError(f"{OPTION}: {error}") from None
