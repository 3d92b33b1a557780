"""A server for one page, on this machine only."""

from __future__ import annotations

import hmac
import os
import re
import secrets
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

HOST = "127.0.0.1"
_THIS_MACHINE = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:\d*)?", re.IGNORECASE)
"""Of the header Host, with any port: a tunnel has its own."""


def open_page(url: str) -> bool:
    """Whether a browser with a window opens ``url``."""
    windowless = sys.platform not in ("win32", "darwin") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
    return not windowless and webbrowser.open(url)


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    protocol_version = "HTTP/1.1"
    server_version = "meshsplats"
    sys_version = ""
    timeout = 60

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def _answer(self, *, body: bool) -> None:
        if not hmac.compare_digest(self.path.encode(), self.server.path.encode()):
            self.send_error(404)
            return
        # A page elsewhere whose name was made to lead here asks with its own name.
        if not _THIS_MACHINE.fullmatch(self.headers.get("Host", "")):
            port = self.server.server_port
            at, tunnel = f"http://localhost:{port}{self.path}", f"ssh -L {port}:127.0.0.1:{port} SERVER"
            explained = f"This page is for its own machine: open it as {at}, from elsewhere after {tunnel}"
            self.send_error(404, explain=explained)
            return
        self.send_response(200)
        for name, value in {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Length": str(len(self.server.page)),
            "Cache-Control": "no-store",
            "Content-Security-Policy": "frame-ancestors 'none'",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            self.wfile.write(self.server.page)

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not news."""


class PageServer(ThreadingHTTPServer):
    """Serves ``page`` on a free port of this machine, at a path that cannot be guessed, and nothing else."""

    daemon_threads = True

    def __init__(self, page: str) -> None:
        self.page = page.encode("utf-8")
        self.path = f"/{secrets.token_urlsafe(24)}/"
        super().__init__((HOST, 0), _Handler)

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.server_port}{self.path}"

    def handle_error(self, request: object, client_address: object) -> None:
        """Browsers break off connections; that is no error of ours."""


@contextmanager
def serving(page: str) -> Iterator[PageServer]:
    """A server that has its port; ``serve_forever`` answers until it is interrupted."""
    server = PageServer(page)
    try:
        yield server
    finally:
        server.server_close()
