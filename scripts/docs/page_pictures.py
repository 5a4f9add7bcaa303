"""Draw the pictures of pages that need no run: costs, a held input, segments, forms.

    python scripts/docs/page_pictures.py

Writes SVG files into cluster_est/docs, from the library's own costs and limits and from
simulations of the embedded example. They have colours for a light and for a dark page.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))  # equations of the FMUs
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from docs import cost_picture, form_pictures, step_picture
from docs.fit_pictures import noise_picture, shooting_picture

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "cluster_est" / "docs"
PICTURES = {
    "costs_and_limits": cost_picture.picture,
    "held_input": step_picture.picture,
    "multiple_shooting": shooting_picture,
    "process_noise": noise_picture,
}
"""By the names of their files."""


def main() -> None:
    """Write the pictures."""
    for name, picture in (PICTURES | {"form_shapes": form_pictures.picture}).items():
        path = DOCS / f"{name}.svg"
        path.write_text(picture(), encoding="utf-8")
        print(path.relative_to(ROOT).as_posix(), f"{path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
