"""The workbench of a closed loop: what fits models, with what was asked for and what is known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter, SimulationMeter
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace
from cluster_est.running.runner import Runner
from cluster_est.statistics.records import StackedRecords
from workers.fmu.description import ModelDescription
from workers.messages import FloatArray


@dataclass(frozen=True)
class LoopWorkbench:
    """A loop that is open: only recipes and what puts a result into words have all of it.

    Attributes
    ----------
    fitter
        Of the models.
    settings
        Of the loop.
    sites, notes
        For the report: what was open, and what a reader should know.
    sigma_declared
        The user has given a sigma, for whatever output.
    first_fit
        The declared model from the user's start, where that was needed before.
    """

    fitter: Fitter
    settings: LoopSettings
    sites: tuple[str, ...]
    notes: tuple[str, ...]
    sigma_declared: bool = False
    first_fit: FittedModel | None = field(default=None, repr=False)

    def enter(self, phase: str) -> None:
        """Tell who watches the run what it is about from now on."""
        self.runner.display.phase = phase

    @property
    def filtered(self) -> bool:
        """The problem has process noise: its residuals are innovations of a Kalman filter."""
        return self.fitter.predicts

    @property
    def runner(self) -> Runner:
        return self.fitter.runner

    @property
    def problem(self) -> Problem:
        return self.fitter.problem

    @property
    def description(self) -> ModelDescription:
        return self.fitter.description

    @property
    def seed(self) -> int:
        return self.fitter.seed

    @property
    def train(self) -> tuple[int, ...]:
        return self.fitter.train

    @property
    def records(self) -> StackedRecords:
        return self.fitter.records

    @property
    def meter(self) -> SimulationMeter:
        return self.fitter.meter

    @property
    def size(self) -> int:
        return self.fitter.size

    @property
    def sigmas(self) -> FloatArray:
        return self.fitter.sigmas

    def noise_floor(self, noise: FloatArray) -> float:
        """See `Fitter`."""
        return self.fitter.noise_floor(noise)

    def noise_in_units(self, noise: FloatArray) -> dict[str, float]:
        """See `Fitter`."""
        return self.fitter.noise_in_units(noise)

    def generator(self, stream: int) -> np.random.Generator:
        """See `Fitter`."""
        return self.fitter.generator(stream)

    def space(self, start: FitStart) -> SearchSpace:
        """See `Fitter`."""
        return self.fitter.space(start)

    def trajectories(self, fitted: FittedModel) -> list[LinearisedTrajectory]:
        """See `Fitter`."""
        return self.fitter.trajectories(fitted)
