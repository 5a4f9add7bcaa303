"""Run folders as the commands leave them: their facts and tables, without what clocks say."""

import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from support.problems.springs import ROOT

from cluster_est.run_folder.log_segment import read_log

SPRING = str(ROOT / "configs" / "mass_spring_damper.toml")
CLOCKS = {"seconds", "busy_seconds", "started", "ended", "worker", "workers"}
"""Columns and keys that tell of clocks and of who has simulated."""
BEGUN = ("format", "seed", "started", "config_hash", "fmu", "experiments", "versions")
"""What stands in run.json before the first result."""


def facts(run: Path) -> dict[str, Any]:
    """All of run.json."""
    found: dict[str, Any] = json.loads((run / "run.json").read_text(encoding="utf-8"))
    found.pop("checksum", None)
    return found


def facts_without_clocks(run: Path) -> dict[str, Any]:
    """What stands in run.json whenever and wherever the run is done."""
    clocks = ("seconds", "started", "ended")
    return {key: value for key, value in facts(run).items() if key not in clocks}


def change_facts(run: Path, **changes: Any) -> None:
    """Write something else into run.json."""
    (run / "run.json").write_text(json.dumps(facts(run) | changes), encoding="utf-8")


def leave_as_killed(run: Path) -> None:
    """Leave of a finished run what a kill leaves of it."""
    kept = {key: facts(run)[key] for key in BEGUN}
    (run / "run.json").write_text(json.dumps({"status": "running", "verdict": None, **kept}))
    for table in run.glob("*.parquet"):
        table.unlink()


def rows(run: Path, table: str) -> list[dict[str, Any]]:
    """The rows of a table."""
    found: list[dict[str, Any]] = pq.read_table(run / f"{table}.parquet").to_pylist()
    return found


def evaluations(run: Path) -> list[str]:
    """What was simulated and came out, as text, in an order that does not depend on arrival."""
    columns = ["search", "evaluation", "experiment", "purpose", "key", "values", "effects"]
    table = read_log(run / "evaluations")
    table = table.select([*columns, "residuals_hash", "status", "message", "bound", "cost"])
    found = table.sort_by([(name, "ascending") for name in columns[:5]]).to_pylist()
    assert all(row["residuals_hash"] or row["status"] != "ok" for row in found)
    return [repr(row) for row in found]  # in which NaN is the same as NaN


def tables(run: Path) -> dict[str, str]:
    """Every table of results as text: NaN is not equal to itself, its text is."""
    found = {}
    for path in sorted(set(run.glob("*.parquet")) - {run / "workers.parquet"}):
        table = pq.read_table(path)
        kept = [name for name in table.column_names if name not in CLOCKS]
        found[path.stem] = repr(table.select(kept).to_pylist())
    return found


def copy_spring(folder: Path) -> None:
    """Copy the spring, its data and its FMU, so that a test may change them: spring.toml."""
    configs = ROOT / "configs"
    shutil.copy(SPRING, folder / "spring.toml")
    shutil.copytree(configs / "data" / "mass_spring_damper", folder / "data/mass_spring_damper")
    (folder / "models").mkdir()
    shutil.copy(configs / "models" / "mass_spring_damper.fmu", folder / "models")
