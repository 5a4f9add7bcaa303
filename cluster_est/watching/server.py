"""The server of the page, only for this machine and for clients with its token.

A web site that is open in the same browser can also send requests to this machine, but it does not
have the token. Requests for another host name (DNS rebinding) and requests from a page of another
origin are refused even with the token.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import importlib.resources
import json
import re
import secrets
import threading
from collections.abc import Mapping
from functools import cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qs, urlsplit

from typing_extensions import override

from cluster_est.errors import ClusterEstError, RunFolderError
from cluster_est.watching.page_sources import RunPages

LOOPBACK = "127.0.0.1"
SECONDS_TO_NOTICE = 0.05
"""Longest delay until the server notices that it is closed."""
SECONDS_OF_REQUEST = 30.0
"""Seconds after which an idle connection is closed."""
REFUSED = "open this page on this machine, with the address that the command printed"


class LivePage:
    """Serves the page of a run, or of a folder of runs, until it is closed.

    Parameters
    ----------
    folder
        Folder of a run, which may not exist yet, or of runs.
    port
        Port of the server; 0 for any free port.
    config
        The original config of the run, if it has moved.
    allow_code
        Whether Python functions named in the config may run.

    Attributes
    ----------
    address
        Address with the token.

    Raises
    ------
    RunFolderError
        If the port is in use.
    """

    def __init__(
        self,
        folder: Path,
        port: int = 0,
        config: Path | None = None,
        *,
        allow_code: bool = False,
    ) -> None:
        self._pages = RunPages(folder, config, allow_code=allow_code)
        token = secrets.token_urlsafe(32)
        try:
            self._server = _Server((LOOPBACK, port), self._pages, token)
        except OSError as error:
            raise RunFolderError(
                f"--port: {port} cannot be used ({error.strerror}); choose another port, or "
                "leave --port out"
            ) from error
        self.host, self.port = self._server.server_address[:2]
        self.address = f"http://{LOOPBACK}:{self.port}/?token={token}"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(SECONDS_TO_NOTICE,), daemon=True
        )

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()
        self._pages.close()

    def last_look(self, seconds: float) -> None:
        """Wait until an open page has read the end of the run, but not longer than `seconds`."""
        self._pages.seen_at_the_end(seconds)


class _Server(ThreadingHTTPServer):
    """Contains the data for the handler of each request."""

    daemon_threads = True
    allow_reuse_address = False

    def __init__(self, address: tuple[str, int], pages: RunPages, token: str) -> None:
        super().__init__(address, _Handler)
        self.pages, self.token = pages, token.encode()
        port = self.server_address[1]
        self.hosts = tuple(f"{name}:{port}" for name in (LOOPBACK, "localhost"))

    @override
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing when a browser has disconnected."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one request: the page, its data as JSON, or an order to stop."""

    server: _Server
    server_version, sys_version = "cluster-est", ""
    timeout = SECONDS_OF_REQUEST

    @override
    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing, because addresses contain the token."""

    def do_GET(self) -> None:
        self._answer({"/": self._page, "/state": self._state, "/curves": self._curves})

    def do_POST(self) -> None:
        self._answer({"/stop": self._stop})

    def _answer(self, known: Mapping[str, Any]) -> None:
        address = urlsplit(self.path)
        asked = {name: values[-1] for name, values in parse_qs(address.query).items()}
        if not self._is_allowed(asked.get("token", "")):
            self._send(HTTPStatus.FORBIDDEN, {"problem": REFUSED})
        elif address.path not in known:
            self._send(HTTPStatus.NOT_FOUND, {"problem": "there is no such page"})
        else:
            known[address.path](asked)

    def _is_allowed(self, token: str) -> bool:
        """Return whether the token is correct, and the request comes from the page itself."""
        hosts = self.server.hosts
        origins = [f"http://{host}" for host in hosts]
        return (
            hmac.compare_digest(token.encode("utf-8", "replace"), self.server.token)
            and self.headers.get("Host", "") in hosts
            and self.headers.get("Origin", origins[0]) in origins
        )

    def _page(self, _: Mapping[str, str]) -> None:
        page, policy = live_page()
        self._write(HTTPStatus.OK, "text/html; charset=utf-8", page, policy)

    def _state(self, asked: Mapping[str, str]) -> None:
        self._told(lambda: self.server.pages.state(asked.get("run", "")))

    def _curves(self, asked: Mapping[str, str]) -> None:
        run, experiment = asked.get("run", ""), asked.get("experiment", "")
        self._told(lambda: self.server.pages.curves(run, experiment))

    def _stop(self, asked: Mapping[str, str]) -> None:
        self._told(lambda: self.server.pages.stop(asked.get("run", "")))

    def _told(self, make: Any) -> None:
        try:
            self._send(HTTPStatus.OK, make())
        except (ClusterEstError, OSError) as error:  # the next request may succeed
            self._send(HTTPStatus.CONFLICT, {"problem": str(error)})

    def _send(self, status: HTTPStatus, found: Mapping[str, Any]) -> None:
        text = json.dumps(found, allow_nan=False)
        self._write(status, "application/json", text.encode(), "default-src 'none'")

    def _write(self, status: HTTPStatus, kind: str, content: bytes, policy: str) -> None:
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(content))),
            ("Content-Security-Policy", policy),
            ("Cache-Control", "no-store"),
            ("Referrer-Policy", "no-referrer"),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)


@cache
def live_page() -> tuple[bytes, str]:
    """Return the page, and a policy that allows only its own scripts and requests."""
    file = importlib.resources.files("cluster_est.watching").joinpath("live.html")
    text = file.read_text(encoding="utf-8")
    script, style = (_digest(text, tag) for tag in ("script", "style"))
    policy = (
        f"default-src 'none'; script-src 'sha256-{script}'; style-src 'sha256-{style}'; "
        "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )
    return text.encode(), policy


def _digest(text: str, tag: str) -> str:
    (content,) = re.findall(f"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
    return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
