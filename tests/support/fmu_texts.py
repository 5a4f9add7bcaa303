"""What an FMU of `scripts/build_fmus.py` holds beside its binaries."""

import zipfile
from pathlib import Path

from build_fmus import c_header, model_description, read_model


def texts_in(archive: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(archive) as contents:
        names = [n for n in contents.namelist() if not n.startswith("binaries/")]
        return {n: contents.read(n) for n in names}


def texts_from(folder: Path) -> dict[str, bytes]:
    """What it would hold if it were built from the sources in this folder now."""
    model = read_model(folder)
    sources = model.sources | {"model_variables.h": c_header(model).encode()}
    texts = {f"sources/{file}": text for file, text in sources.items()}
    return texts | {"modelDescription.xml": model_description(model)}
