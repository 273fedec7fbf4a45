"""Clients of the stream that do not read: bounded buffers, closed after a deadline."""

import base64
import socket
import time
from urllib.parse import urlsplit

import httpx
import pytest

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
    end = time.monotonic() + 60.0
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
        connection.settimeout(20.0)
        received = b""
        while part := connection.recv(1 << 16):
            received += part
            if b"read nothing" in received:
                break
    code = received[received.rindex(b"the client read nothing") - 2 :][:2]
    assert int.from_bytes(code, "big") == websocket_limits.STALLED
