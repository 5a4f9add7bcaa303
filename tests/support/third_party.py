"""FMUs that other tools made, from a published wheel: fetched for tests and never kept here.

$CLUSTER_EST_FMUS may name a folder that holds them instead.
"""

import os
import subprocess
import sys
import zipfile
from pathlib import Path, PurePosixPath

import platformdirs

WHEEL = "gemseo-fmu==3.1.1"
FOLDER = "gemseo_fmu/problems/fmu_files/linux/"


def third_party_fmus(scratch: Path) -> Path | None:
    """The folder of the FMUs; None if they are neither here nor can be fetched."""
    given = os.environ.get("CLUSTER_EST_FMUS")
    if given:
        return Path(given)
    kept = Path(platformdirs.user_cache_dir("cluster-est")) / "tests" / WHEEL.replace("==", "-")
    if kept.is_dir():
        return kept
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", WHEEL]
    try:
        subprocess.run(command, cwd=scratch, check=True, timeout=300, capture_output=True)
        (wheel,) = scratch.glob("*.whl")
    except (subprocess.SubprocessError, OSError, ValueError):
        return None
    unpacked = scratch / "fmus"
    unpacked.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if name.startswith(FOLDER) and name.endswith(".fmu"):
                (unpacked / PurePosixPath(name).name).write_bytes(archive.read(name))
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        unpacked.rename(kept)
    except OSError:  # another run was faster, or it cannot be kept: it is good for this one
        return kept if kept.is_dir() else unpacked
    return kept
