import shutil
from pathlib import Path

import pytest
from support.reported import fitted_run


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two springs with an output that is seen at 150 times, and a third held out."""
    return fitted_run(tmp_path_factory.mktemp("fit") / "run", experiments=3)


@pytest.fixture
def copied(run: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be changed."""
    return Path(shutil.copytree(run, tmp_path / "copy"))
