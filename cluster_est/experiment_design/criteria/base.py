"""The contract of a criterion: how much an experiment is worth before it has been made."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.experiment_design.prediction import PredictedExperiment
from cluster_est.plug_in import check_class_attributes


class DesignCriterion(ABC):
    """A measure of what an experiment will tell."""

    name: ClassVar[str]
    """As in a file of limits."""

    compares: ClassVar[bool]
    """Whether it compares models, and so needs two; the others look at the first one alone."""

    predicts: ClassVar[bool] = False
    """Whether it needs to know what is to be predicted: `FittedCandidate.targets`."""

    called: ClassVar[str]
    """What a table calls its value, with the unit."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        check_class_attributes(cls)

    @abstractmethod
    def value(
        self,
        models: Sequence[FittedCandidate],
        predicted: Sequence[PredictedExperiment],
        parameters: Sequence[str],
    ) -> float:
        """Return the worth of an experiment; more is better.

        Parameters
        ----------
        models, predicted
            The models, and what each predicts of the experiment.
        parameters
            Labels of the unknowns of the first model that count.
        """
