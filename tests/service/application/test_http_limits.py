"""Connections that send no head, half of one, or one without end: nobody is locked out."""

import json
import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest
import uvicorn

from service.application import http_limits
from service.application.http_limits import HEAD_BYTES, MAX_HEADERS
from service.problems.handlers import SECURITY_HEADERS

CONNECTIONS = 8
GET = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
CLOSED_GET = b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"


async def answer(scope: Any, receive: Any, send: Any) -> None:
    """Take the body, then say how long it was."""
    received, more = 0, True
    while more:
        message = await receive()
        received += len(message.get("body", b""))
        more = message.get("more_body", False)
    body = str(received).encode()
    headers = [(b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The port of a server as `lumiline serve` runs it, but for the application."""
    monkeypatch.setattr(http_limits, "HEAD_S", 0.5)
    listening = socket.create_server(("127.0.0.1", 0), backlog=100)
    server = uvicorn.Server(
        uvicorn.Config(
            answer,
            http="service.application.http_limits:LimitedHttpProtocol",
            ws="service.application.websocket_limits:LimitedWebSocketProtocol",
            limit_concurrency=CONNECTIONS,
            lifespan="off",
            log_config=None,
            timeout_keep_alive=30,
        )
    )
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    yield listening.getsockname()[1]
    server.should_exit = True
    thread.join()


def opened(port: int, sent: bytes = b"") -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=20.0)
    connection.sendall(sent)
    return connection


def everything(connection: socket.socket) -> bytes:
    """Return what comes until the server closes."""
    found = b""
    with connection:
        while part := connection.recv(65536):
            found += part
    return found


def problem(found: bytes) -> tuple[int, str]:
    """Return status and type of an answer, which has the headers of all others."""
    head, body = found.split(b"\r\n\r\n", 1)
    first, *lines = head.decode().split("\r\n")
    headers = dict(line.lower().split(": ", 1) for line in lines)
    assert headers["content-type"] == "application/problem+json"
    assert headers["content-length"] == str(len(body))
    assert headers["connection"] == "close"
    for name, value in SECURITY_HEADERS.items():
        assert headers[name.lower()] == value.lower()
    document = json.loads(body)
    assert int(first.split()[1]) == document["status"]
    return document["status"], document["type"]


def test_silence_is_closed(port: int) -> None:
    assert everything(opened(port)) == b""


@pytest.mark.slow
def test_half_a_head(port: int) -> None:
    assert problem(everything(opened(port, GET[:-2]))) == (408, "/problems/head-too-slow")


@pytest.mark.slow
def test_half_of_a_second_head(port: int) -> None:
    connection = opened(port, GET)
    assert connection.recv(1000).startswith(b"HTTP/1.1 200")
    connection.sendall(GET[:-2])
    assert problem(everything(connection)) == (408, "/problems/head-too-slow")


def test_a_slow_body_is_not_a_slow_head(port: int) -> None:
    connection = opened(port, b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\n\r\na")
    silent = opened(port)
    assert everything(silent) == b""  # so long that a head would not be waited for
    connection.sendall(b"b")
    assert ends_with(connection, b"\r\n\r\n2")
    connection.close()


@pytest.mark.parametrize("end", [b"", b"\r\n\r\n"])
@pytest.mark.parametrize("begin", [b"GET / HTTP/1.1\r\nHost: x\r\nX: ", b"GET /?"])
def test_a_head_that_is_too_large(port: int, begin: bytes, end: bytes) -> None:
    tail = (b" HTTP/1.1" if b"?" in begin else b"") + end
    connection = opened(port, begin + b"a" * (HEAD_BYTES + 1) + (tail if end else b""))
    assert problem(everything(connection)) == (431, "/problems/head-too-large")


@pytest.mark.parametrize("more", [0, 1])
def test_head_with_too_many_short_headers_is_refused(port: int, more: int) -> None:
    headers = b"".join(b"a%d:\r\n" % number for number in range(MAX_HEADERS - 2 + more))
    head = b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n" + headers + b"\r\n"
    found = everything(opened(port, head))
    if more:
        assert problem(found) == (431, "/problems/head-too-large")
    else:
        assert found.startswith(b"HTTP/1.1 200")


def test_many_trailers_of_a_body_end_the_connection(port: int) -> None:
    head = b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n"
    trailers = b"".join(b"a%d:\r\n" % number for number in range(10 * MAX_HEADERS))
    assert b" 200 " not in everything(opened(port, head + trailers + b"\r\n"))


def test_a_body_may_be_larger(port: int) -> None:
    body = b"a" * (3 * HEAD_BYTES)
    head = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % len(body)
    connection = opened(port)
    for _ in range(2):  # each alone, and one connection for both
        connection.sendall(head + body)
        assert ends_with(connection, b"\r\n\r\n%d" % len(body))
    connection.close()


def test_what_is_no_http(port: int) -> None:
    found = everything(opened(port, b"nonsense\r\n\r\n"))
    assert problem(found) == (400, "/problems/malformed-request")


def test_request_beyond_those_at_once_is_refused_like_any_other(port: int) -> None:
    # Half a body each: they are being answered, and are not evicted.
    busy = [
        opened(port, b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\n\r\na")
        for _ in range(CONNECTIONS - 1)
    ]
    for one in busy:
        one.settimeout(20.0)
    found = b""
    while b" 503 " not in found:  # the server may not have read all of those yet
        found = everything(opened(port, CLOSED_GET))
    assert problem(found) == (503, "/problems/busy")
    assert b"retry-after: 5" in found
    for one in busy:
        one.sendall(b"b")
        assert one.recv(1000).startswith(b"HTTP/1.1 200")
        one.close()


def test_silent_connections_lock_nobody_out(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_limits, "HEAD_S", 600.0)
    silent = [opened(port) for _ in range(3 * CONNECTIONS)]
    for _ in range(3):
        connection = opened(port, GET)
        assert connection.recv(1000).startswith(b"HTTP/1.1 200")
        connection.close()
    for one in silent:
        one.close()


@pytest.mark.parametrize(
    ("handshake", "refused"),
    [
        (b"", (400, "/problems/malformed-request")),
        (b"Sec-WebSocket-Key: short\r\n", (400, "/problems/malformed-request")),
        (b"Sec-WebSocket-Version: 8\r\n", (400, "/problems/malformed-request")),
    ],
)
def test_what_is_no_handshake_is_refused_as_other_requests_are(
    port: int, handshake: bytes, refused: tuple[int, str]
) -> None:
    upgrade = b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    assert problem(everything(opened(port, upgrade + handshake + b"\r\n"))) == refused


def test_a_websocket_whose_application_fails_is_answered_as_other_requests_are(port: int) -> None:
    handshake = (
        b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )
    assert problem(everything(opened(port, handshake))) == (500, "/problems/internal-error")


def ends_with(connection: socket.socket, end: bytes) -> bool:
    """Receive an answer until it ends so; its head and body may come apart."""
    received = b""
    while not received.endswith(end):
        part = connection.recv(1000)
        if not part:
            return False
        received += part
    return True
