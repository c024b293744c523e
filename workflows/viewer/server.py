"""A read-only HTTP server for this machine alone."""

from __future__ import annotations

import logging
import mimetypes
import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from scanloom.schemas.errors import ScanloomError, UsageError
from scanloom.workflows.viewer.answers import Answers, Missing

LOOPBACK = "127.0.0.1"
HERE = Path(__file__).parent
IDLE_S = 60.0
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
        "connect-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
}
_log = logging.getLogger("scanloom.viewer")


def pages() -> dict[str, tuple[str, bytes]]:
    """The files of the page by their paths: nothing else of the disk can be asked for."""
    found = {}
    for path in [*(HERE / "page").iterdir(), HERE / "vendor" / "vendor.js"]:
        kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
        found[f"/{path.name}"] = ("text/javascript" if path.suffix == ".js" else kind, path.read_bytes())
    found["/"] = found["/index.html"]
    return found


class Server(ThreadingHTTPServer):
    """Answers on 127.0.0.1 only."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, port: int, answers: Answers) -> None:
        """
        Raises
        ------
        UsageError : the port is taken.
        """
        self.answers = answers
        self.pages = pages()
        try:
            super().__init__((LOOPBACK, port), Handler)
        except OSError as error:
            raise UsageError(
                f"port {port} cannot be used: {error.strerror}",
                next_step="give another with --port, or --port 0 for any that is free",
            ) from error

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that no longer wants an answer hangs up; that is no error."""
        if isinstance(sys.exception(), ConnectionError):
            return
        _log.error("a request failed", exc_info=True)

    @property
    def url(self) -> str:
        return f"http://{LOOPBACK}:{self.server_port}/"

    @property
    def hosts(self) -> set[str]:
        """What a browser on this machine calls us. Another name means that somebody's DNS points here."""
        return {f"{name}:{self.server_port}" for name in (LOOPBACK, "localhost")}


class Handler(BaseHTTPRequestHandler):
    """GET and HEAD of known paths, from pages of our own."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version = "scanloom"
    sys_version = ""
    timeout = IDLE_S

    def do_GET(self) -> None:
        status, kind, body = self._answer()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_HEAD(self) -> None:
        self.do_GET()

    def _answer(self) -> tuple[HTTPStatus, str, bytes]:
        if self.headers.get("Host", "") not in self.server.hosts:
            return _refusal(HTTPStatus.MISDIRECTED_REQUEST, "unknown host")
        if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            return _refusal(HTTPStatus.FORBIDDEN, "not for other sites")
        path = unquote(urlsplit(self.path).path)
        if path in self.server.pages:
            return HTTPStatus.OK, *self.server.pages[path]
        if not path.startswith("/data/"):
            return _refusal(HTTPStatus.NOT_FOUND, "nothing here")
        try:
            return HTTPStatus.OK, *self.server.answers.answer(path.removeprefix("/data/"))
        except Missing:
            return _refusal(HTTPStatus.NOT_FOUND, "nothing here")
        except ScanloomError as error:
            _log.warning("%s", error)
            return _refusal(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))

    def log_message(self, format: str, *args: object) -> None:
        _log.debug(format, *args)


def _refusal(status: HTTPStatus, why: str) -> tuple[HTTPStatus, str, bytes]:
    return status, "text/plain; charset=utf-8", why.encode()
