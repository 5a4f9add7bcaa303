"""What hatchling runs before it makes a wheel: the libraries in C are built and put into it.

A wheel gets them for every platform, by zig, so that it is one for all. An installation in place
(`pip install -e .`) gets those of this machine alone, in the source tree: by the system's compiler
where there is one, else by zig. The table of what is built is in `workers/core/build.py`.
"""

from __future__ import annotations

import os
import sys
import tempfile
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ZIG_CACHE = "ZIG_GLOBAL_CACHE_DIR"
"""What zig has compiled of its own libraries, 70 MB, goes to a temporary folder, and so nothing is
left; set this to a folder to keep it there: the next wheel takes seconds."""


class BuildHook(BuildHookInterface):
    """Builds the libraries of `workers.core.build`."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        sys.path.insert(0, self.root)
        from workers.core import build

        self._folder = tempfile.TemporaryDirectory(prefix="cluster-est-build-")
        os.environ.setdefault(ZIG_CACHE, os.path.join(self._folder.name, "zig"))
        if version == "editable":
            self._build_in_place(build)
        else:
            build_data["force_include"].update(self._build_for_all(build))

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        self._folder.cleanup()

    def _build_for_all(self, build: ModuleType) -> dict[str, str]:
        """Build in the temporary folder; return where each library is to be in the wheel."""
        included = {}
        for kind in build.KINDS:
            for platform in build.PLATFORMS:
                name = build.carried_path(kind, platform).name
                target = Path(self._folder.name, name)
                self.app.display_info(f"building {name} with zig")
                build.compile_for(platform, target, kind)
                included[str(target)] = f"workers/core/binaries/{name}"
        return included

    def _build_in_place(self, build: ModuleType) -> None:
        here = build.this_platform()
        build.BINARIES.mkdir(exist_ok=True)
        for kind in build.KINDS:
            place = build.carried_path(kind, here)
            if place.is_file():
                continue
            for old in build.BINARIES.glob(f"{kind}-{here}-*"):
                old.unlink()
            self.app.display_info(
                f"building {place.name} with {build.system_compiler() or 'zig'}, for this machine "
                "alone"
            )
            build.build_into(place, partial(_compile_here, build, kind))


def _compile_here(build: ModuleType, kind: str, target: Path) -> None:
    """Compile with the system's compiler, or with zig where there is none, or one that fails."""
    try:
        build.compile_to(target, build.sources(kind))
    except build.ModelError:
        if build.system_compiler() is None:
            raise
        build.compile_for(build.this_platform(), target, kind)
