"""Benchmark of a stream beside clients that never read: latencies of those that do, and /healthz.

Run beside a service: ``python -m benchmarks.stalled_clients URL --stalled 100 --good 10``. Rounds
without and with stalled clients follow each other in turn.
"""

import argparse
import asyncio
import base64
import json
import socket
import sys
import time
from typing import Any, Final
from urllib.parse import urlsplit

import msgpack
from websockets.asyncio.client import connect

from benchmarks.stream_clients import percentiles

PROBE_S: Final = 0.02


async def _read(url: str, end: float, latencies_ns: list[int]) -> None:
    async with connect(url, compression=None, max_size=None, max_queue=64) as stream:
        while time.monotonic() < end:
            message = msgpack.unpackb(await stream.recv())
            if message["type"] == "frame":
                latencies_ns.append(time.time_ns() - message["exposure_ns"])


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
    """Return the latencies of good clients and of /healthz [ms]."""
    end = time.monotonic() + seconds
    latencies: list[int] = []
    probes: list[int] = []
    opened: list[socket.socket] = []
    url = f"{server.replace('http', 'ws', 1)}/api/v1/stream?{query}"
    async with asyncio.TaskGroup() as tasks:
        for _ in range(good):
            tasks.create_task(_read(url, end, latencies))
        tasks.create_task(_probe(server, end, probes))
        await asyncio.sleep(seconds / 10)
        lossless = f"{query}&mode=lossless&content=points,peaks"
        opened += [_open_unread(server, lossless) for _ in range(stalled)]
    for connection in opened:
        connection.close()
    return {
        "stalled": stalled,
        "frames": len(latencies),
        "frame_ms": percentiles(latencies),
        "healthz_ms": percentiles(probes),
    }


def main(arguments: list[str] | None = None) -> int:
    """Print the figures of each round as a line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("server")
    parser.add_argument("--device", default="sim")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--good", type=int, default=10)
    parser.add_argument("--stalled", type=int, default=80)
    chosen = parser.parse_args(arguments)
    for _ in range(chosen.rounds):
        for stalled in (0, chosen.stalled):
            query = f"device={chosen.device}"
            found = asyncio.run(measure(chosen.server, query, chosen.seconds, chosen.good, stalled))
            print(json.dumps(found), flush=True)
            time.sleep(1.0)
    return 0


if __name__ == "__main__":
    sys.exit(main())
