"""A key that has no effect any more is accepted, and its author told what has."""

from __future__ import annotations

from pathlib import Path

import pytest

from cluster_est.config.former_keys import former_keys
from cluster_est.config.reader import read_config
from cluster_est.config.settings import build_resources
from workers.messages import Limits

CONFIG = """
model = { fmu = "a.fmu" }
executor = { name = "processes"FORMER }
[[experiments]]
id = "a"
data = "a.csv"
time = "t"
outputs = { y = "y" }
"""


@pytest.mark.parametrize("value", ["", ", patience = 20.0", ", patience = 0.0"])
def test_patience(tmp_path: Path, value: str) -> None:
    path = tmp_path / "config.toml"
    path.write_text(CONFIG.replace("FORMER", value), encoding="utf-8")
    config = read_config(path)
    said = "".join(former_keys(config))
    assert ("executor.patience: has no effect any more" in said) == bool(value)
    assert all(key in said for key in ("max_steps", "stall", "timeout") if value)
    assert build_resources(config).limits == Limits()
