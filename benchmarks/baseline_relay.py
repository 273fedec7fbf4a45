"""Baseline of the latency benchmark: a serial device's bytes in, as many messages out, no more.

Each exposure that the device sends becomes a websocket message of the same size as the service's,
which begins with the exposure's first bytes as they came. Nothing is decoded.
"""

import asyncio
import socket
import sys
from contextlib import AbstractContextManager
from typing import Final

from benchmarks.peer_process import inherited_listener, running_peer

PREFIX_BYTES: Final = 64
"""Of each exposure that are passed on."""
MIN_EXPOSURE_BYTES: Final = 1024  # status and answers are shorter


def running_baseline_relay(
    device: tuple[str, int], start: bytes, message_bytes: int
) -> AbstractContextManager[str]:
    """Run it in a process of its own; the context is its URL.

    Args:
        device: host and port of the serial device; connected while a client is.
        start: what makes it send exposures.
        message_bytes: size of each message.
    """
    host, port = device
    return running_peer(
        "benchmarks.baseline_relay", host, str(port), start.hex(), str(message_bytes)
    )


async def _serve(listener: socket.socket) -> None:
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.exceptions import ConnectionClosed

    host, port, start = sys.argv[2], int(sys.argv[3]), bytes.fromhex(sys.argv[4])
    size = int(sys.argv[5])

    async def relay(connection: ServerConnection) -> None:
        reader, writer = await asyncio.open_connection(host, port, limit=1 << 20)
        writer.write(start)
        try:
            while True:
                exposure = await reader.readuntil(b"\0")
                if len(exposure) >= MIN_EXPOSURE_BYTES:
                    await connection.send(exposure[:PREFIX_BYTES].ljust(size, b"\0"))
        except (ConnectionClosed, asyncio.IncompleteReadError):
            return
        finally:
            writer.close()

    async with serve(relay, sock=listener, compression=None):
        await asyncio.get_running_loop().create_future()


if __name__ == "__main__":
    import uvloop

    uvloop.run(_serve(inherited_listener()))
