"""Baseline of the live benchmark: a websocket that sends messages of the same size and rate."""

import asyncio
import socket
import time
from contextlib import AbstractContextManager
from typing import Any

from benchmarks.peer_process import inherited_listener, running_peer

RATE_HZ = 1000.0


def _message(sequence: int, exposure_ns: int) -> dict[str, Any]:
    """Return a frame message like the service's, with one point."""
    covariance = [[1e-4, 1e-5, 1e-5], [1e-5, 1e-4, 1e-5], [1e-5, 1e-5, 1e-3]]
    point = {
        "marker": 0,
        "position_mm": [12.3456789, -23.456789, 1499.87654],
        "covariance_mm2": covariance,
        "residual_sigma": 0.987654,
        "sensors": ["vertical", "horizontal", "diagonal-rising", "diagonal-falling"],
        "flags": [],
    }
    return {
        "type": "frame",
        "device_id": "sim",
        "sequence": sequence,
        "exposure_ns": exposure_ns,
        "device_ns": exposure_ns,
        "marker": 0,
        "calibration_id": "sim-nominal",
        "flags": [],
        "points": [point],
    }


async def _serve(listener: socket.socket) -> None:
    import msgpack
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.exceptions import ConnectionClosed

    async def send(connection: ServerConnection) -> None:
        start, host = time.monotonic_ns(), time.time_ns()
        sequence = 0
        try:
            while True:
                due = round(sequence * 1e9 / RATE_HZ)
                await asyncio.sleep(max(0.0, (start + due - time.monotonic_ns()) * 1e-9))
                await connection.send(msgpack.packb(_message(sequence, host + due)))
                sequence += 1
        except ConnectionClosed:
            return

    async with serve(send, sock=listener, compression=None):
        await asyncio.get_running_loop().create_future()


def running_baseline_stream() -> AbstractContextManager[str]:
    """Run it in a process of its own; the context is its URL."""
    return running_peer("benchmarks.baseline_stream")


if __name__ == "__main__":
    asyncio.run(_serve(inherited_listener()))
