"""Clients of the stream that do not read: bounded buffers, closed after a deadline."""

import base64
import socket
import time
from contextlib import ExitStack
from urllib.parse import urlsplit

import httpx
import msgpack
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.application import websocket_limits


def open_unread(server: str, query: str) -> socket.socket:
    """Open a stream by hand, so that nothing reads what comes."""
    host = urlsplit(server)
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.connect((host.hostname, host.port))
    key = base64.b64encode(bytes(16)).decode()
    connection.sendall(
        f"GET /api/v1/stream?{query} HTTP/1.1\r\nHost: {host.netloc}\r\nUpgrade: websocket\r\n"
        f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
        .encode()
    )  # fmt: skip
    return connection


def subscribers(server: str) -> int:
    found: int = httpx.get(f"{server}/api/v1/devices/sim/state").json()["subscribers"]
    return found


def wait_for_subscribers(server: str, count: int) -> None:
    end = time.monotonic() + 240.0
    while subscribers(server) != count:
        assert time.monotonic() < end, f"there are {subscribers(server)} subscribers"
        time.sleep(0.05)


@pytest.mark.slow
def test_stream_of_client_that_reads_nothing_is_closed_with_code(
    server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(websocket_limits, "STALL_S", 0.3)
    monkeypatch.setattr(websocket_limits, "LINGER_S", 60.0)
    wait_for_subscribers(server, 0)
    with open_unread(server, "device_id=sim&mode=lossless&content=points,peaks") as connection:
        wait_for_subscribers(server, 1)
        wait_for_subscribers(server, 0)
        connection.settimeout(240.0)
        received = b""
        while part := connection.recv(1 << 16):
            received += part
            if b"read nothing" in received:
                break
    code = received[received.rindex(b"the client read nothing") - 2 :][:2]
    assert int.from_bytes(code, "big") == websocket_limits.STALLED


def greetings(server: str, count: int) -> None:
    """Open streams one beside another, and read the greeting of each."""
    url = f"{server.replace('http', 'ws', 1)}/api/v1/stream?device_id=sim"
    with ExitStack() as stack:
        for _ in range(count):
            stream = stack.enter_context(connect(url, close_timeout=0.1))
            assert msgpack.unpackb(stream.recv(60))["type"] == "hello"


def wait_for_turns() -> None:
    """Wait until the next stream may be opened, after the rest."""
    end = time.monotonic() + 240.0
    while any(one._value < websocket_limits.OPENING for one in websocket_limits._turns.values()):
        assert time.monotonic() < end
        time.sleep(0.01)


def greet_once(server: str) -> None:
    """Open one stream, and wait until the next may be opened."""
    greetings(server, 1)
    wait_for_turns()


@pytest.mark.slow
def test_opened_streams_give_their_turn_to_the_next(server: str) -> None:
    greetings(server, 3 * websocket_limits.OPENING)
    with pytest.raises(InvalidStatus):
        connect(f"{server.replace('http', 'ws', 1)}/api/v1/stream?device_id=none-such")
    greet_once(server)
    turns = [turns._value for turns in websocket_limits._turns.values()]
    assert turns
    assert set(turns) == {websocket_limits.OPENING}


@pytest.mark.slow
def test_streams_are_opened_one_after_another_with_a_rest(
    server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    greet_once(server)
    monkeypatch.setattr(websocket_limits, "REST_S", 0.5)
    begin = time.monotonic()
    greetings(server, 3)
    assert time.monotonic() - begin >= 1.0
    monkeypatch.undo()
    wait_for_turns()


def test_streams_that_take_long_to_open_keep_nobody_out(
    server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    greet_once(server)
    monkeypatch.setattr(websocket_limits, "OPENING_WAIT_S", 0.05)
    for turns in websocket_limits._turns.values():
        monkeypatch.setattr(turns, "_value", 0)
    greetings(server, 2)
