"""Build of a wheel: hatchling's backend, and the libraries in C, which are added to the wheel.

A wheel contains the libraries for all platforms, built by zig, so that one wheel serves all. An
editable installation (`pip install -e .`) contains only those of this machine, in the source tree.
They are built by the system's compiler if there is one, otherwise by zig, which is a download of
100 MB. `workers/core/build.py` lists the libraries.
"""

from __future__ import annotations

import os
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import hatchling.build

# All of them, because the required functions of a backend depend on the front end.
from hatchling.build import *  # noqa: F403
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

sys.path.insert(0, str(Path(__file__).parents[1]))
from workers.core import build
from workers.errors import ModelError

ZIG = "ziglang>=0.17,<0.18"
ZIG_CACHE = "ZIG_GLOBAL_CACHE_DIR"
"""Variable for the folder of zig's compiled own libraries (70 MB). By default, it is a temporary
folder, so that nothing is left. A given folder is kept, which is useful if zig itself stays in its
place (`--no-build-isolation`)."""


def get_requires_for_build_wheel(config_settings: dict[str, Any] | None = None) -> list[str]:
    return [*hatchling.build.get_requires_for_build_wheel(config_settings), ZIG]


def get_requires_for_build_editable(config_settings: dict[str, Any] | None = None) -> list[str]:
    asked = hatchling.build.get_requires_for_build_editable(config_settings)
    return asked if has_working_compiler() else [*asked, ZIG]


def has_working_compiler() -> bool:
    """Return whether the system's compiler builds libraries; on Windows, compilers differ."""
    if sys.platform == "win32":
        return False
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "trial.c")
        source.write_text(
            "#include <math.h>\n#include <stdlib.h>\nint a(void) { return abs(1); }\n"
        )
        try:
            build.compile_to(Path(folder, "trial"), [source])
        except ModelError:
            return False
    return True


class BuildHook(BuildHookInterface):
    """Builds the libraries of `workers.core.build`."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="cluster-est-build-")
        os.environ.setdefault(ZIG_CACHE, os.path.join(self._folder.name, "zig"))
        if version == "editable":
            self._build_in_place()
        else:
            build_data["force_include"].update(self._build_for_all())

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        self._folder.cleanup()

    def _build_for_all(self) -> dict[str, str]:
        """Build in the temporary folder; return the path of each library in the wheel."""
        included = {}
        for kind in build.KINDS:
            for platform in build.PLATFORMS:
                name = build.carried_path(kind, platform).name
                target = Path(self._folder.name, name)
                self.app.display_info(f"building {name} with zig")
                build.compile_for(platform, target, kind)
                included[str(target)] = f"workers/core/binaries/{name}"
        return included

    def _build_in_place(self) -> None:
        here = build.this_platform()
        by_zig = build.zig() is not None
        build.BINARIES.mkdir(exist_ok=True)
        for kind in build.KINDS:
            place = build.carried_path(kind, here)
            if place.is_file():
                continue
            for old in build.BINARIES.glob(f"{kind}-{here}-*"):
                old.unlink()
            compiler = "zig" if by_zig else build.compiler()
            self.app.display_info(f"building {place.name} with {compiler}, for this machine alone")
            build.build_into(place, partial(_compile_here, kind, by_zig))


def _compile_here(kind: str, by_zig: bool, target: Path) -> None:
    if by_zig:
        build.compile_for(build.this_platform(), target, kind)
    else:
        build.compile_to(target, build.sources(kind))
