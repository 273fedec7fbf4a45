"""Benchmark of a stream beside clients that never read: latencies of good ones, and /healthz."""

import asyncio
import base64
import socket
import time
from typing import Any, Final
from urllib.parse import urlsplit

import msgpack
from websockets.asyncio.client import connect

from benchmarks.stream_clients import percentiles

PROBE_S: Final = 0.02
SETTLED_S: Final = 2.0
"""After this the stalled ones are connected and have their buffers full."""


async def _read(
    url: str, end: float, settled: float, latencies_ns: list[int], settled_ns: list[int]
) -> None:
    async with connect(url, compression=None, max_size=None, max_queue=64) as stream:
        while time.monotonic() < end:
            message = msgpack.unpackb(await stream.recv())
            if message["type"] == "frame":
                latencies_ns.append(time.time_ns() - message["exposure_ns"])
                if time.monotonic() > settled:
                    settled_ns.append(latencies_ns[-1])


async def _probe(server: str, end: float, latencies_ns: list[int]) -> None:
    host = urlsplit(server)
    reader, writer = await asyncio.open_connection(host.hostname, host.port)
    while time.monotonic() < end:
        begin = time.monotonic_ns()
        writer.write(f"GET /healthz HTTP/1.1\r\nHost: {host.netloc}\r\n\r\n".encode())
        await reader.readuntil(b"}")
        latencies_ns.append(time.monotonic_ns() - begin)
        await asyncio.sleep(PROBE_S)
    writer.close()


def _open_unread(server: str, query: str) -> socket.socket:
    host = urlsplit(server)
    connection = socket.create_connection((host.hostname, host.port))
    key = base64.b64encode(bytes(16)).decode()
    connection.sendall(
        f"GET /api/v1/stream?{query} HTTP/1.1\r\nHost: {host.netloc}\r\nUpgrade: websocket\r\n"
        f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
        .encode()
    )  # fmt: skip
    return connection


async def measure(server: str, query: str, seconds: float, good: int, stalled: int) -> Any:
    """Return the latencies of good clients and of /healthz [ms].

    The stalled ones connect at once after a tenth of the time; ``settled_ms`` is of SETTLED_S after
    that and later, with or without them.
    """
    end = time.monotonic() + seconds
    settled = end - 0.9 * seconds + SETTLED_S
    latencies: list[int] = []
    latencies_settled: list[int] = []
    probes: list[int] = []
    opened: list[socket.socket] = []
    url = f"{server.replace('http', 'ws', 1)}/api/v1/stream?{query}"
    async with asyncio.TaskGroup() as tasks:
        for _ in range(good):
            tasks.create_task(_read(url, end, settled, latencies, latencies_settled))
        tasks.create_task(_probe(server, end, probes))
        await asyncio.sleep(seconds / 10)
        lossless = f"{query}&mode=lossless&content=points,peaks"
        # In a thread: the good ones read meanwhile.
        opened += await asyncio.to_thread(
            lambda: [_open_unread(server, lossless) for _ in range(stalled)]
        )
    for connection in opened:
        connection.close()
    return {
        "stalled": stalled,
        "frames": len(latencies),
        "frame_ms": percentiles(latencies),
        "settled_ms": percentiles(latencies_settled),
        "healthz_ms": percentiles(probes),
    }
