"""A file of limits for the next experiment, read and checked."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from cluster_est.config.predictions import prediction_targets
from cluster_est.config.sections.design import LimitsSections
from cluster_est.errors import ConfigError, ProblemError
from cluster_est.experiment_design.limits import ExperimentLimits, InputLimits, SignalLimits
from cluster_est.experiment_design.settings import DesignSettings
from cluster_est.settings import error_messages
from workers.messages.checks import as_path


@dataclass(frozen=True)
class LimitsFile:
    """The contents of a file of limits.

    Attributes
    ----------
    limits, settings, seed
        Of the experiment, and what it is chosen for.
    text
        Of the file.
    """

    limits: ExperimentLimits
    settings: DesignSettings
    seed: int
    text: str


def read_limits(path: str | Path) -> LimitsFile:
    """Read and check a file of limits.

    Raises
    ------
    ConfigError
        If there is no such file, it is not TOML, or something in it is wrong.
    """
    path = as_path(path, "--limits", ConfigError)
    try:
        text = path.read_text(encoding="utf-8-sig")
        raw = tomllib.loads(text)
    except FileNotFoundError:
        raise ConfigError(f"--limits: there is no file {path}; check the path") from None
    except OSError as error:
        raise ConfigError(
            f"--limits: {path} must be a file that can be read but cannot be ({error.strerror}); "
            "check the path"
        ) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: must be TOML but is not: {error}; mend that line") from None
    try:
        found = LimitsSections.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(
            "\n".join(error_messages(error, str(path), raw, LimitsSections))
        ) from None
    try:
        return _built(found, text, path.parent)
    except ProblemError as error:
        raise ConfigError(f"{path}: {error}") from None


def _built(found: LimitsSections, text: str, base: Path) -> LimitsFile:
    limits = ExperimentLimits(
        inputs={name: InputLimits(**each.model_dump()) for name, each in found.inputs.items()},
        duration=found.duration,
        sample_time=found.sample_time,
        signals={name: SignalLimits(**each.model_dump()) for name, each in found.signals.items()},
        like=found.like,
        start={name: SignalLimits(**each.model_dump()) for name, each in found.start.items()},
    )
    settings = DesignSettings(
        criterion=found.criterion,
        parameters=tuple(found.parameters),
        rivals=tuple(found.rivals),
        waveforms=tuple(found.waveforms),
        candidates=found.candidates,
        predictions=prediction_targets(found.predictions, base),
    )
    return LimitsFile(limits, settings, found.seed, text)
