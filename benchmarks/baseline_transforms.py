"""Baseline of the navigation benchmark: sends transforms on schedule."""

import asyncio
import socket
import struct
import time
from contextlib import AbstractContextManager
from typing import Final

from benchmarks.peer_process import inherited_listener, running_peer

RATE_HZ: Final = 1000.0
_HEADER: Final = struct.Struct(">H12s20sIIQQ")
_BODY: Final = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 10, 20, 30)
_NS: Final = 1_000_000_000


async def _send(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    step = int(_NS / RATE_HZ)
    due = time.time_ns()
    while not writer.is_closing():
        due += step
        await asyncio.sleep(max(0.0, (due - time.time_ns()) * 1e-9))
        whole, rest = divmod(due, _NS)
        stamp = whole, (rest << 32) // _NS
        # Nobody checks: a checksum would be part of what is compared.
        writer.write(_HEADER.pack(1, b"TRANSFORM", b"bareToTracker", *stamp, len(_BODY), 0) + _BODY)
        await writer.drain()


async def _serve(listener: socket.socket) -> None:
    async with await asyncio.start_server(_send, sock=listener) as server:
        await server.serve_forever()


def running_baseline_transforms() -> AbstractContextManager[str]:
    """Run it in a process of its own; the context is its URL, whose host and port count."""
    return running_peer("benchmarks.baseline_transforms")


if __name__ == "__main__":
    asyncio.run(_serve(inherited_listener()))
