"""One HTML file from a template, which fetches nothing and runs no script but its own."""

from __future__ import annotations

import base64
import hashlib
import importlib.resources
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from cluster_est.errors import RunFolderError
from cluster_est.whole_files import ELSEWHERE, write_whole


def rendered(template: str, **values: Any) -> str:
    """Fill a template, with the style, the script and the policy that every page has."""
    script = _asset("report.js")
    return (
        _environment()
        .get_template(template)
        .render(
            style=Markup(_asset("report.css")),
            script=Markup(script),
            policy=_policy(script),
            **values,
        )
    )


def write_page(path: Path, text: str) -> None:
    """Write a file in one step.

    Raises
    ------
    RunFolderError
        If it is a folder or cannot be written.
    """
    if path.is_dir():
        raise RunFolderError(f"{path}: must be a file but is a folder; choose another --out")
    write_whole(path, text.encode(), ELSEWHERE, shared=True)


def _policy(script: str) -> str:
    """Nothing may be fetched, and only this script may run."""
    return (
        f"default-src 'none'; script-src 'sha256-{_sha256(script)}'; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("cluster_est.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _asset(name: str) -> str:
    file = importlib.resources.files("cluster_est.report").joinpath("templates", name)
    return file.read_text(encoding="utf-8")
