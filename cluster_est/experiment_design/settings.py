"""Settings of a design: what an experiment is chosen for, and how hard it is searched for."""

from __future__ import annotations

from dataclasses import dataclass, field

from cluster_est.errors import ProblemError
from cluster_est.experiment_design.candidates import RECORDED
from cluster_est.experiment_design.criteria import CRITERIA
from cluster_est.experiment_design.targets import PredictionTarget
from cluster_est.experiment_design.waveforms import WAVEFORMS
from cluster_est.problem.options import check_options
from workers.fmu.description import nearest
from workers.messages.checks import as_tuple


@dataclass(frozen=True)
class DesignSettings:
    """What an experiment is chosen for, and how hard it is searched for.

    Attributes
    ----------
    criterion
        "discriminate" to tell the rivals of a finding apart, "d" or "a" to narrow parameters, "v"
        to narrow predictions; "" for "v" where there are `predictions`, to discriminate where there
        are rivals, else "d".
    parameters
        Names or labels of the parameters that are narrowed; empty for all that experiments share.
    predictions
        What is predicted, for "v"; empty for all outputs of all experiments of the run.
    rivals
        Names of the models that are told apart; empty for all that the run kept.
    waveforms
        Families of inputs, and "recorded" for the inputs of the run's experiments as they are;
        empty for all.
    candidates
        How many inputs are looked at.

    Raises
    ------
    ProblemError
        If one is of the wrong kind or out of its range.
    """

    criterion: str = ""
    parameters: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()
    waveforms: tuple[str, ...] = ()
    candidates: int = field(default=120, metadata={"least": 10})
    predictions: tuple[PredictionTarget, ...] = ()

    def __post_init__(self) -> None:
        check_options(self, "design", ProblemError)
        for key in ("parameters", "rivals", "waveforms"):
            given = getattr(self, key)
            object.__setattr__(self, key, as_tuple(given, str, key, ProblemError))
        targets = as_tuple(self.predictions, PredictionTarget, "predictions", ProblemError)
        object.__setattr__(self, "predictions", targets)
        if self.criterion and self.criterion not in CRITERIA:
            known = ", ".join(repr(name) for name in CRITERIA)
            raise ProblemError(
                f"criterion: must be one of {known} but is {self.criterion!r}"
                f"{nearest(self.criterion, CRITERIA)}"
            )
        if self.predictions and self.criterion and not CRITERIA[self.criterion].predicts:
            raise ProblemError(
                f'predictions: must go with the criterion "v", which narrows them, but it is '
                f"{self.criterion!r}; change one of the two"
            )
        known_waveforms = [*WAVEFORMS, RECORDED]
        for name in self.waveforms:
            if name not in known_waveforms:
                raise ProblemError(
                    f"waveforms: must be of {', '.join(known_waveforms)} but has {name!r}"
                    f"{nearest(name, known_waveforms)}"
                )
