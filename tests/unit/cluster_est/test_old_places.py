"""What stood elsewhere in the version before is still found there, with a word about it."""

import importlib

import pytest

from cluster_est.problem.search_space.space import SearchSpace
from cluster_est.run_folder.evaluation_log import read_log


@pytest.mark.parametrize(
    ("module", "name", "thing"),
    [
        ("cluster_est.space", "Space", SearchSpace),
        ("cluster_est.evaluation_log", "read_log", read_log),
    ],
)
def test_an_old_place_still_works_with_a_warning(module: str, name: str, thing: object) -> None:
    with pytest.warns(DeprecationWarning, match=f"{module}: .* import it from there"):
        found = importlib.import_module(module)
    assert getattr(found, name) is thing
