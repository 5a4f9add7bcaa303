import os
from pathlib import Path

import pytest
from support.problems.springs import ROOT

PLACES = [Path(os.environ.get("CLUSTER_EST_DATA", "/nowhere")), ROOT.parent / "shared" / "data"]


def measured(file: str) -> Path:
    """A measured file; skips the test where it is not to be had."""
    for place in PLACES:
        if (place / file).is_file():
            return place / file
    pytest.skip(f"the measured data is not here; put {file} below $CLUSTER_EST_DATA")
