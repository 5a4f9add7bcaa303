"""The stages of a closed loop: their names in the log, and what a person reads."""

from __future__ import annotations

import enum


class LoopStage(enum.Enum):
    """A stage of a closed loop; its value is the name of its searches in the log.

    Attributes
    ----------
    title
        A text for people, as in "stopped while ...".
    """

    title: str

    def __new__(cls, value: str, title: str) -> LoopStage:
        """Make a member of a name and a title."""
        stage = object.__new__(cls)
        stage._value_ = value
        stage.title = title
        return stage

    WEIGHTS = "weights", "weighting the outputs"
    DECLARED_MODEL = "base", "fitting the declared model"
    LEAVE_ONE_OUT = "leave one out", "predicting experiments that were left out"
    TRAJECTORIES = "course", "screening the candidates"
    TESTS = "tests", "testing the candidates"
    PROBE = "probe", "screening the candidates"
    TRIALS = "trial", "trying candidates"
    REFITS = "candidate", "refitting candidates"
    ENLARGED_INPUTS = "enlarged", "simulating with larger inputs"
    DECLARED_AGAIN = "return", "fitting the declared model again"
    OTHER_STARTS = "other starts", "refitting from other starts"
    SWAP = "swap", "revising the effects"
    DROP = "drop", "revising the effects"
    FINAL = "final", "the final fits"
    PROCESS_NOISE = "process noise", "fitting the process noise"


def stage_title(search: str) -> str:
    """Return what a person reads of a search, by its name in the log; the name if it is no stage's.

    The final fits have searches of their own beside "final", such as "before" and "after".
    """
    titles = {stage.value: stage.title for stage in LoopStage}
    return titles.get(search, search)
