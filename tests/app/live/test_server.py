"""The server of a live run's page: whom it answers, what, and that nobody can hold it up."""

import http.client
import re
import socket
import time
from contextlib import closing, suppress

import numpy as np
import pytest

from driftlab.live import server as live_server
from driftlab.live.history import History, LiveHistory
from driftlab.live.server import CLIENTS, LOOPBACK, PATIENCE, TABS, Server, serving
from fusion_core.errors import ConfigError

HTML = "<style>p{}</style><script>1</script><p>hello"


@pytest.fixture
def server():
    watch = LiveHistory(("x",))
    watch.end([], "out")
    with serving(Server(0, HTML, watch)) as found:
        yield found


def asked(server, path="/", method="GET", host="127.0.0.1:80", **headers):
    connection = http.client.HTTPConnection(*server.server_address, timeout=20)
    connection.putrequest(method, path, skip_host=True)
    for name, value in ({"Host": host} | headers).items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


@pytest.mark.parametrize("host", ["127.0.0.1:8088", "localhost", "LOCALHOST:9000", "[::1]:9000"])
def test_it_answers_under_the_names_of_this_machine(server, host):
    answer, body = asked(server, host=host)
    assert (answer.status, body) == (200, HTML.encode())


@pytest.mark.parametrize("host", [
    "evil.example", "evil.example:8088", "127.0.0.1.evil.example", "192.168.0.7:8088", "0.0.0.0", "localhost.", "",
    None, "[::1", "user@evil.example", "localhost@evil.example",
])  # fmt: skip
@pytest.mark.parametrize("path", ["/", "/status.json", "/history"])
def test_it_answers_under_no_other_name(server, host, path):
    answer, body = asked(server, path, host=host)
    assert answer.status == 421
    assert b"has no other name" in body


@pytest.mark.parametrize("path", [
    "/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/live.js", "/status.json/", "/favicon.ico",
    "http://evil.example/", "*", "/\\..\\x",
])  # fmt: skip
def test_there_is_nothing_else(server, path):
    assert asked(server, path)[0].status == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "HEAD"])
def test_it_can_only_be_read(server, method):
    answer, _ = asked(server, "/status.json", method, Origin="http://evil.example")
    assert (answer.status, answer.headers["Allow"]) == (405, "GET")


@pytest.mark.parametrize("path", ["/", "/status.json", "/history", "/nothing"])
def test_no_other_page_may_read_or_frame_it(server, path):
    headers = asked(server, path, Origin="http://evil.example")[0].headers
    assert not [name for name in headers if name.lower().startswith("access-control")]
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert headers["X-Content-Type-Options"] == "nosniff"
    policy = dict(part.strip().split(" ", 1) for part in headers["Content-Security-Policy"].split(";"))
    # echo -n 1 | openssl dgst -sha256 -binary | base64
    assert policy["script-src"] == "'sha256-a4ayc/80/OGda4BO/1o/V0etpOqiLx1JwB5S3beHW0s='"
    assert policy["default-src"] == "'none'"
    assert policy["connect-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"


def test_it_listens_on_the_loopback_address_alone(server):
    assert server.server_address[0] == LOOPBACK == "127.0.0.1"


@pytest.mark.parametrize(
    "query", ["", "?generation=x&rows=-1", "?rows=99999999999999999999&of=nothing", "?of=last&rows=3"]
)
def test_a_history_can_be_asked_for_in_any_words(server, query):
    names = server.watch.histories["whole"].names
    for history in server.watch.histories.values():
        history.add(np.column_stack([np.arange(5.0), np.ones((5, len(names) - 1))]))
    answer, body = asked(server, f"/history{query}")
    generation, at, columns, width, *values = np.frombuffer(body, "<f8")
    assert answer.status == 200
    assert (generation, columns, width) == (0, len(names), 0.5)
    np.testing.assert_array_equal(
        np.reshape(values, (-1, len(names))), server.watch.histories["whole"].view.rows[int(at) :]
    )


def test_clients_that_are_slow_hold_up_nobody(server):
    """100 that send a byte now and then, 100 that read nothing: others are answered at once, and they are cut off."""
    server.watch.histories["whole"] = big = History(["t", "v"], 1.0, "widen")
    big.add(np.column_stack([np.arange(3600.0), np.ones(3600)]))
    clients = [socket.create_connection(server.server_address) for _ in range(200)]
    for client in clients[::2]:
        client.sendall(b"GET /history HTTP/1.0\r\nHost: localhost\r\n\r\n")
    begun = time.monotonic()
    while time.monotonic() - begun < PATIENCE + 2:
        for client in clients[1::2]:
            with suppress(OSError):
                client.sendall(b"G")
        answer, body = asked(server)
        assert (answer.status, body) == (200, HTML.encode())
        time.sleep(0.2)
    for client in clients[1::2]:
        client.settimeout(5)
        with suppress(ConnectionError):
            assert client.recv(1) == b""  # patience is for the request, not for each byte
    for client in clients:
        client.close()


def test_of_more_clients_than_are_served_the_oldest_goes(server):
    clients = [socket.create_connection(server.server_address) for _ in range(2 * CLIENTS)]
    for _ in range(20):
        answer, body = asked(server)
        assert (answer.status, body) == (200, HTML.encode())
    for client in clients:
        client.close()


@pytest.mark.parametrize("raw", [
    b"GET http://[/ HTTP/1.1\r\nHost: localhost\r\n\r\n", b"\r\n\r\n", b"GET /\r\n\r\n",
    b"\xff\xfe\0 / HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nX: \xe9\r\n\r\n", b"GET /?" + b"a=1&" * 100 + b" HTTP/1.1\r\n\r\n",
    b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n", b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
])  # fmt: skip
def test_what_is_no_request_is_answered_or_closed(server, raw, capfd):
    with socket.create_connection(server.server_address) as client:
        client.settimeout(20)
        with suppress(ConnectionError):
            client.sendall(raw)
            assert client.recv(64)[:9] in (b"HTTP/1.1 ", b"")
    assert asked(server)[0].status == 200
    assert "Traceback" not in capfd.readouterr().err


def test_a_port_that_cannot_be_had_is_told_with_what_to_do(server):
    port = server.server_address[1]
    taken = f"--web {port}: the port cannot be had (Address already in use); name another, or 0 for any that is free"
    with pytest.raises(ConfigError, match=re.escape(taken)):
        Server(port, HTML, LiveHistory(("x",)))
    with pytest.raises(ConfigError, match="--web 65536: is not a port; name one up to 65535, or 0 for any that is f"):
        Server(65_536, HTML, LiveHistory(("x",)))


def test_it_stays_until_those_who_look_on_know_the_end():
    watch = LiveHistory(("x",))
    with serving(Server(0, HTML, watch)) as server:
        asked(server, "/status.json?tab=one")
        asked(server, "/status.json?tab=two")
        assert set(server.tabs) == {"one", "two"}
        watch.end(["what one should know"], "out")
        for tab in ("one", "two"):
            assert b'"failed": false' in asked(server, f"/status.json?tab={tab}")[1]
            asked(server, f"/history?tab={tab}&last=1")
        begun = time.monotonic()
        while server.tabs:  # noted when the answer is out
            assert time.monotonic() - begun < 60
            time.sleep(0.01)
    with pytest.raises(ConnectionRefusedError):
        asked(server)
    for k in range(1000):
        server.heard(f"tab {k}", knows=False)
    assert len(server.tabs) <= TABS


def test_tabs_that_were_closed_make_room_for_new_ones(monkeypatch):
    """A page that is loaded again is another tab: a long run has had many."""
    now = 0.0
    monkeypatch.setattr(live_server.time, "monotonic", lambda: now)
    server = Server(0, HTML, LiveHistory(("x",)))
    with closing(server.socket):
        for k in range(3 * TABS):
            now += live_server.RECENT
            server.heard(f"tab {k}", knows=False)
        assert set(server.tabs) == {f"tab {k}"}
