"""The page of a live run, served to the browsers of this machine.

Nothing that one of them does holds up the run, or another: one thread serves all by turns, each connection has one
request and a time for all of it, the oldest one goes where there are too many, and what they are given was made before
they asked. The server listens on the loopback address, answers GET alone, under the names of this machine alone (a page
of another origin that has its name point here is refused), and knows three paths.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import re
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from email.parser import BytesParser
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from driftlab.live.history import LiveHistory
from driftlab.storage.hdf5 import reason
from fusion_core.errors import ConfigError

LOOPBACK = "127.0.0.1"
OURS = {LOOPBACK, "localhost", "::1"}
TABS = 32  # whose end is waited for
CLIENTS = 256  # connections; one more, and the oldest is closed
REQUEST = 16_384  # bytes of a request; what is longer is closed
PATIENCE = 5.0  # s for a request and its answer, from the first byte to the last
LEAVING = 0.5  # s at the end for answers that are on their way
RECENT = 3.0  # s: whoever asked by then is still there, and is waited for when the run has ended
LARGEST_PORT = 65_535
NOTHING = b"there is nothing here\n"
TYPES = {"/": "text/html; charset=utf-8", "/status.json": "application/json", "/history": "application/octet-stream"}


class Server:
    """Serves status and history of one run and the page `html`, at a port; 0: any that is free.

    Raises ConfigError if the port cannot be had.
    """

    def __init__(self, port: int, html: str, watch: LiveHistory) -> None:
        self.html, self.watch = html.encode(), watch
        self.policy = policy_of(html)
        self.tabs: dict[str, float] = {}  # when each asked last; those that know that the run has ended are not in it
        self._clients: dict[asyncio.Task[Any], None] = {}  # the oldest first
        if not 0 <= port <= LARGEST_PORT:
            raise ConfigError(f"--web {port}: is not a port; name one up to {LARGEST_PORT}, or 0 for any that is free")
        try:
            self.socket = socket.create_server((LOOPBACK, port), backlog=CLIENTS)
        except OSError as error:
            raise ConfigError(
                f"--web {port}: the port cannot be had ({reason(error)}); name another, or 0 for any that is free"
            ) from None
        self.server_address: tuple[str, int] = self.socket.getsockname()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{LOOPBACK}:{self.server_address[1]}/"

    async def serve(self, ended: asyncio.Event) -> None:
        """Answer until `ended` is set."""
        async with await asyncio.start_server(self._client, sock=self.socket, limit=REQUEST):
            await ended.wait()
            clients = list(self._clients)
            if clients:  # what was answered leaves
                await asyncio.wait(clients, timeout=LEAVING)
            for client in clients:
                client.cancel()

    async def _client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request; whoever takes too long for it, or is the oldest of too many, is cut off."""
        task = asyncio.current_task()
        assert task is not None
        self._clients[task] = None
        if len(self._clients) > CLIENTS:
            next(iter(self._clients)).cancel()
        try:
            async with asyncio.timeout(PATIENCE):
                writer.write(self._answer(await reader.readuntil(b"\r\n\r\n")))
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (OSError, EOFError, asyncio.LimitOverrunError, asyncio.CancelledError):  # a TimeoutError is an OSError
            writer.transport.abort()
        finally:
            del self._clients[task]

    def _answer(self, request: bytes) -> bytes:
        """Return the answer to a request."""
        line, _, rest = request.partition(b"\r\n")
        words, headers = line.decode("latin-1").split(" "), BytesParser().parsebytes(rest, headersonly=True)
        if len(words) != 3 or not words[2].startswith("HTTP/1."):
            return self._response(400, b"this is no request of HTTP/1\n")
        method, target, _ = words
        try:
            parts = urlsplit(target)
            asked = {key: values[-1] for key, values in parse_qs(parts.query, max_num_fields=20).items()}
        except ValueError:
            return self._response(400, b"this is no address\n")
        if method != "GET":
            return self._response(405, b"" if method == "HEAD" else b"only GET is answered\n", {"Allow": "GET"})
        if _host(headers.get("Host", "")) not in OURS:
            return self._response(421, f"this page is at {self.url} and has no other name\n".encode())
        if parts.netloc or parts.path not in TYPES:  # an address as a proxy is given it
            return self._response(404, NOTHING)
        return self._response(200, self._content(parts.path, asked), {"Content-Type": TYPES[parts.path]})

    def _content(self, path: str, asked: Mapping[str, str]) -> bytes:
        """Return the content of one of the three paths."""
        if path == "/":
            return self.html
        knows = path == "/history" and "last" in asked
        self.heard(asked.get("tab", "")[:40], knows=knows)
        return self.watch.status if path == "/status.json" else self._history(asked)

    def _history(self, asked: Mapping[str, str]) -> bytes:
        """Return numbers of 64 bits: generation, the number of the first row, columns, the width in s, and the rows."""
        histories = self.watch.histories
        view = histories.get(asked.get("of", ""), histories["whole"]).view
        at, rows = view.since(_number(asked.get("generation", "")), _number(asked.get("rows", "")))
        return np.concatenate([[view.generation, at, rows.shape[1], view.width], rows.ravel()]).astype("<f8").tobytes()

    def _response(self, code: int, body: bytes, more: Mapping[str, str] | None = None) -> bytes:
        headers = {
            "Content-Type": "text/plain; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": self.policy,
            "Cross-Origin-Resource-Policy": "same-origin",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
            "Connection": "close",
            "Server": "driftlab",
        } | dict(more or {})
        lines = [f"HTTP/1.1 {code} {HTTPStatus(code).phrase}", *(f"{name}: {value}" for name, value in headers.items())]
        return "\r\n".join([*lines, "", ""]).encode() + body

    def heard(self, tab: str, *, knows: bool) -> None:
        """Note the time at which a tab asked; one that `knows` that the run has ended is forgotten."""
        now = time.monotonic()
        for gone in [other for other, at in list(self.tabs.items()) if now - at >= RECENT]:
            self.tabs.pop(gone, None)
        if knows:
            self.tabs.pop(tab, None)
        elif tab and (tab in self.tabs or len(self.tabs) < TABS):
            self.tabs[tab] = now

    def linger(self) -> None:
        """Wait until all tabs that asked lately know that the run has ended; not for long."""
        begun = time.monotonic()
        while time.monotonic() - begun < RECENT and any(begun - at < RECENT for at in list(self.tabs.values())):
            time.sleep(0.02)


@contextmanager
def serving(server: Server) -> Iterator[Server]:
    """Serve; at the end, wait a moment for those who look on."""
    loop, ended = asyncio.new_event_loop(), asyncio.Event()

    def serve() -> None:
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(server.serve(ended))

    thread = threading.Thread(target=serve, name="server", daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.linger()
        with suppress(RuntimeError):  # its loop is closed
            loop.call_soon_threadsafe(ended.set)
        thread.join()
        server.socket.close()


def _host(text: str) -> str | None:
    """Return the name under which it was asked; the port may be that of a tunnel."""
    try:
        return urlsplit(f"//{text}").hostname
    except ValueError:
        return None


def policy_of(html: str) -> str:
    """Return the Content-Security-Policy of a page: its own scripts and styles, by their hash, and this server."""

    def hashes(tag: str) -> str:
        texts = re.findall(rf"<{tag}(?: [^>]*)?>(.*?)</{tag}>", html, flags=re.DOTALL)
        digests = (hashlib.sha256(text.encode()).digest() for text in texts)
        return " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)

    return (
        f"default-src 'none'; script-src {hashes('script')}; style-src {hashes('style')}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def _number(text: str) -> int:
    """Return a number that was asked for; 0 where it is none."""
    return int(text) if text.isdecimal() and len(text) < 16 else 0
