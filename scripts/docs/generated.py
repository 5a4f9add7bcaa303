"""A hook of mkdocs: the pages that are made from the code, at the time of the build.

In the repository a page of the same name says so, so that links lead somewhere there too.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))

from pages import commands_page, forms_page, keys_page, python_page

PAGES = {
    "keys.md": keys_page,
    "forms.md": forms_page,
    "commands.md": commands_page,
    "python.md": python_page,
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Put them in the place of the files that only say where they are made."""
    for name, page in PAGES.items():
        stand_in = files.get_file_from_path(name)
        if stand_in is not None:
            files.remove(stand_in)
        files.append(File.generated(config, name, content=page()))
    return files
