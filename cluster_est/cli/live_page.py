"""The page of a run in a browser: served by the command of a run, or by `watch`."""

from __future__ import annotations

import html
import os
import sys
import tempfile
import threading
import time
import webbrowser
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cluster_est.cli.answer import Answer
from cluster_est.errors import RunFolderError
from cluster_est.watching.page_sources import runs_below
from cluster_est.watching.server import LivePage

SECONDS_OF_SLEEP = 3600.0
SECONDS_OF_LAST_LOOK = 3.0
"""Seconds for which a finished run waits, so that an open page can load the result."""


@contextmanager
def page_beside(folder: Path, *, allow_code: bool) -> Iterator[None]:
    """Serve the page of a run while it is running."""
    page = LivePage(folder, allow_code=allow_code)
    with page, _opened(page.address):
        yield
        page.last_look(SECONDS_OF_LAST_LOOK)


def browse(options: Namespace, answer: Answer) -> None:
    """Serve the page of a run or of a folder of runs until the command is interrupted.

    Raises
    ------
    RunFolderError
        If there is no run, or the port is taken.
    """
    if options.json:
        raise RunFolderError(
            "--browser: must be used without --json, because --browser serves a page until Ctrl-C "
            "and prints no document; remove one of the two"
        )
    folder: Path = options.run_folder
    if not (folder / "run.json").is_file() and not runs_below(folder):
        raise RunFolderError(
            f"{folder}: must be the folder of a run, or of several runs, but neither this folder "
            "nor a folder in it has a run.json"
        )
    page = LivePage(folder, options.port, options.config, allow_code=options.allow_code)
    try:
        with page, _opened(page.address):
            while True:
                time.sleep(SECONDS_OF_SLEEP)
    except KeyboardInterrupt:  # the usual end
        answer.say("the page was closed")


@contextmanager
def _opened(address: str) -> Iterator[None]:
    """Print the address of a page, and open it in a browser on a machine with a screen.

    The browser opens a file that only this user can read and that redirects to the page. Otherwise
    the token would be visible to other users in the arguments of the browser's process.
    """
    print(f"cluster-est: the page of the run is at {address}", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory(prefix="cluster-est-page-") as folder:
        if _has_screen():
            file = Path(folder) / "open.html"
            target = html.escape(address, quote=True)
            file.write_text(
                '<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer">'
                f'<meta http-equiv="refresh" content="0;url={target}"><a href="{target}">open</a>',
                encoding="utf-8",
            )
            threading.Thread(target=webbrowser.open, args=(file.as_uri(),), daemon=True).start()
        yield


def _has_screen() -> bool:
    """Return whether a terminal is attached, and a browser can open a window."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    windows = sys.platform in ("win32", "darwin")
    return windows or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
