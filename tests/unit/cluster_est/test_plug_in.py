"""A class that somebody adds says in a sentence what is wrong with it, when it is imported."""

from typing import ClassVar

import pytest

from cluster_est.costs import Cost
from cluster_est.executors import WorkerPool
from cluster_est.methods import Method


@pytest.mark.parametrize("base", [Cost, Method, WorkerPool])
def test_a_name_that_would_be_an_option_is_refused(base):
    with pytest.raises(TypeError, match=r"Wrong\.name: must be .* write name: ClassVar\[str\]$"):

        class Wrong(base):
            name: str = "wrong"


def test_what_is_set_without_an_annotation_or_with_the_right_one_is_fine():
    class Right(Cost):
        name: ClassVar[str] = "right"
        reduction = "squares"
        scale: float = 1.0

    assert (Right.name, Right.reduction) == ("right", "squares")


def test_the_base_of_the_base_counts_too():
    class Family(Cost):
        strength: ClassVar[float]

    with pytest.raises(TypeError, match=r"strength: ClassVar\[float\]$"):

        class Wrong(Family):
            strength: float = 1.0
