"""Settings of a run from a config: closed loop, starts, uncertainty, executor and budget."""

from __future__ import annotations

from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.config.reader import Config
from cluster_est.errors import ConfigError, EffectError
from cluster_est.running.multistart import Multistart
from cluster_est.running.records import Budget
from cluster_est.running.resources import Resources
from cluster_est.sensitivity.settings import SensitivitySettings
from cluster_est.shooting.settings import Shooting
from cluster_est.uncertainty import UncertaintySettings
from workers.effects.site import parse_site
from workers.messages import Limits


def build_settings(config: Config) -> LoopSettings:
    """Thresholds and sizes of a closed loop.

    Raises
    ------
    ConfigError
        If a site cannot be read.
    """
    section = config.closed_loop
    try:
        sites = [str(parse_site(text, "closed_loop.sites")) for text in section.sites]
    except EffectError as error:
        raise ConfigError(str(error)) from None
    return LoopSettings(
        forms=tuple(section.effects),
        sites=tuple(sites),
        **section.model_dump(exclude={"effects", "sites", "seed"}),
    )


def build_multistart(config: Config) -> Multistart:
    """From how many starts."""
    section = config.multistart
    return Multistart(points=tuple(section.points), **section.model_dump(exclude={"points"}))


def build_shooting(config: Config) -> Shooting | None:
    """Through which segments of the records."""
    section = config.method.shooting
    return None if section is None else Shooting(section.segments, section.length)


def build_uncertainty(config: Config) -> UncertaintySettings:
    """Build the settings of intervals by refits."""
    section = config.uncertainty
    return UncertaintySettings(
        profiles=tuple(section.profiles), **section.model_dump(exclude={"profiles"})
    )


def build_sensitivity(config: Config) -> SensitivitySettings:
    """Design of a sensitivity analysis."""
    return SensitivitySettings(**config.sensitivity.model_dump(exclude={"seed"}))


def build_resources(config: Config) -> Resources:
    """Executor and budget."""
    return Resources(
        executor=config.executor.name,
        workers=config.executor.workers,
        address=config.executor.address,
        budget=Budget(**config.budget.model_dump()),
        limits=_limits(config),
        instances=config.executor.instances,
    )


def _limits(config: Config) -> Limits:
    section = config.executor
    memory = float("inf") if section.memory is None else section.memory * 2.0**20
    return Limits(section.timeout, section.stall, memory, section.growth * 2.0**20)
