"""A hook of mkdocs: the pages that are made from the code, at the time of the build."""

from __future__ import annotations

import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))

from pages import commands_page, keys_page, python_page, tables_page

PAGES = {
    "keys.md": keys_page,
    "tables.md": tables_page,
    "commands.md": commands_page,
    "python.md": python_page,
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add them to the pages that are files."""
    for name, page in PAGES.items():
        files.append(File.generated(config, name, content=page()))
    return files
