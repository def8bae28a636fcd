"""The page of a live run, served to the browsers of this machine.

Nothing that one of them does holds up the run: each request has a thread and a time limit, their number is bounded, and
what they are given was made before they asked. The server listens on the loopback address, answers GET alone, under the
names of this machine alone (a page of another origin that has its name point here is refused), and knows three paths.
"""

from __future__ import annotations

import base64
import hashlib
import re
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from socketserver import TCPServer, ThreadingMixIn
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from fusion_core.errors import ConfigError

if TYPE_CHECKING:
    from driftlab.jobs.live_watch import Watch

LOOPBACK = "127.0.0.1"
OURS = {LOOPBACK, "localhost", "::1"}
AT_ONCE = 32  # requests; more are turned away
PATIENCE = 5.0  # s for a request to be written or read
RECENT = 3.0  # s: whoever asked by then is still there, and is waited for when the run has ended
LARGEST_PORT = 65_535
MIME = {"page": "text/html; charset=utf-8", "json": "application/json", "rows": "application/octet-stream"}


class Server(ThreadingMixIn, TCPServer):
    """Serves one run.

    Parameters
    ----------
    port : int
        0 for any that is free.
    html : str
        The page.
    watch : Watch
        What is shown.

    Raises
    ------
    ConfigError
        If the port cannot be had.
    """

    daemon_threads, block_on_close, allow_reuse_address = True, False, True
    request_queue_size = AT_ONCE

    def __init__(self, port: int, html: str, watch: Watch) -> None:
        self.html, self.watch = html.encode(), watch
        self.policy = policy_of(html)
        self.tabs: dict[str, float] = {}  # when each asked last; those that know that the run has ended are not in it
        self._free = threading.BoundedSemaphore(AT_ONCE)
        if not 0 <= port <= LARGEST_PORT:
            raise ConfigError(f"--web {port}: is not a port; name one up to {LARGEST_PORT}, or 0 for any that is free")
        try:
            super().__init__((LOOPBACK, port), _Request)
        except OSError as error:
            raise ConfigError(
                f"--web {port}: the port cannot be had ({error.strerror}); name another, or 0 for any that is free"
            ) from None

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{LOOPBACK}:{self.server_address[1]}/"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread; turn away who comes when all are busy."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of one who went away."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)

    def heard(self, tab: str, *, knows: bool) -> None:
        """Note that a tab asked, and whether it knows that the run has ended."""
        now = time.monotonic()
        for gone in [other for other, at in list(self.tabs.items()) if now - at >= RECENT]:
            self.tabs.pop(gone, None)
        if knows:
            self.tabs.pop(tab, None)
        elif tab and (tab in self.tabs or len(self.tabs) < AT_ONCE):
            self.tabs[tab] = now

    def linger(self) -> None:
        """Wait until all tabs that asked lately know that the run has ended; not for long."""
        begun = time.monotonic()
        while time.monotonic() - begun < RECENT and any(begun - at < RECENT for at in list(self.tabs.values())):
            time.sleep(0.02)


@contextmanager
def serving(server: Server) -> Iterator[Server]:
    """Serve; at the end, wait a moment for those who look on."""
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, name="server", daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.linger()
        server.shutdown()
        server.server_close()
        thread.join()


def policy_of(html: str) -> str:
    """Return the Content-Security-Policy of a page: its own scripts and styles, by their hash, and this server."""

    def hashes(tag: str) -> str:
        found = re.findall(rf"<{tag}(?: [^>]*)?>(.*?)</{tag}>", html, flags=re.DOTALL)
        return " ".join(
            f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in found
        )

    return (
        f"default-src 'none'; script-src {hashes('script')}; style-src {hashes('style')}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


class _Request(BaseHTTPRequestHandler):
    """One request, on a connection of its own."""

    server: Server
    timeout = PATIENCE
    server_version, sys_version = "driftlab", ""

    def do_GET(self) -> None:
        if not self._ours():
            self._answer(421, "page", f"this page is at {self.server.url} and has no other name\n".encode())
            return
        parts = urlsplit(self.path)
        asked = {key: values[-1] for key, values in parse_qs(parts.query).items()}
        if parts.netloc:  # of a proxy
            self._answer(404, "page", b"there is nothing here\n")
        elif parts.path == "/":
            self._answer(200, "page", self.server.html)
        elif parts.path == "/status.json":
            self.server.heard(asked.get("tab", "")[:40], knows=False)
            self._answer(200, "json", self.server.watch.status)
        elif parts.path == "/history":
            self._answer(200, "rows", self._history(asked))
            self.server.heard(asked.get("tab", "")[:40], knows="last" in asked)
        else:
            self._answer(404, "page", b"there is nothing here\n")

    def _ours(self) -> bool:
        """Whether it was asked by a name of this machine; the port may be that of a tunnel."""
        try:
            return urlsplit(f"//{self.headers.get('Host', '')}").hostname in OURS
        except ValueError:
            return False

    def _history(self, asked: dict[str, str]) -> bytes:
        """Return numbers of 64 bits: generation, the number of the first row, columns, the width in s, and the rows."""
        histories = self.server.watch.histories
        view = histories.get(asked.get("of", ""), histories["whole"]).view
        at, rows = view.since(_number(asked.get("generation", "")), _number(asked.get("rows", "")))
        return np.concatenate([[view.generation, at, rows.shape[1], view.width], rows.ravel()]).astype("<f8").tobytes()

    def _only_get(self) -> None:
        self._answer(405, "page", b"only GET is answered\n", Allow="GET")

    do_POST = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = do_HEAD = _only_get

    def _answer(self, code: int, kind: str, body: bytes, **more: str) -> None:
        self.send_response(code)
        headers = {
            "Content-Type": MIME[kind] if code == 200 else "text/plain; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": self.server.policy,
            "Cross-Origin-Resource-Policy": "same-origin",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
        }
        for name, value in (headers | more).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        pass


def _number(text: str) -> int:
    """Return a number that was asked for; 0 where it is none."""
    return int(text) if text.isdecimal() and len(text) < 16 else 0
