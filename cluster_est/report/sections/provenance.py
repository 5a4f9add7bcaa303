"""The section on the origins of a run, with which it can be repeated."""

from __future__ import annotations

from cluster_est.report.blocks import (
    Block,
    ReportSection,
    SourceBlock,
    TableBlock,
    TableCell,
    cells,
    columns,
)
from cluster_est.report.folder import ReportedRun


def provenance(run: ReportedRun) -> ReportSection:
    """Model, hashes, seed, versions, data and the resolved config."""
    facts = run.facts
    fmu = facts.get("fmu") or {}
    known = [
        ("FMU", fmu.get("name")),
        ("its SHA-256", fmu.get("sha256")),
        ("interface", str(fmu.get("interface") or "").replace("_", " ")),
        ("solver", fmu.get("solver")),
        ("config hash", facts.get("config_hash")),
        ("seed", facts.get("seed")),
        ("started", facts.get("started")),
        ("format", facts.get("format")),
    ]
    rows = [cells(k, TableCell(str(v), code=True)) for k, v in known if v not in (None, "")]
    blocks: list[Block] = [TableBlock(columns("", ""), tuple(rows))]
    versions = facts.get("versions") or {}
    lines = tuple(cells(k, TableCell(str(v), code=True)) for k, v in sorted(versions.items()))
    if lines:
        blocks.append(TableBlock(columns("software", "version"), lines, "Versions", folded=True))
    experiments = facts.get("experiments") or {}
    lines = tuple(cells(str(k), TableCell(str(v), code=True)) for k, v in experiments.items())
    if lines:
        caption = f"Hashes of the {len(lines)} experiments"
        blocks.append(TableBlock(columns("experiment", "hash"), lines, caption, folded=True))
    if run.config:
        blocks.append(SourceBlock("The config, with every default", run.config))
    return ReportSection("provenance", "Where this comes from", tuple(blocks))
