"""Baseline of the load benchmark: a websocket echo server."""

import asyncio
import socket
from contextlib import AbstractContextManager

from benchmarks.peer_process import inherited_listener, running_peer


async def _serve(listener: socket.socket) -> None:
    from websockets.asyncio.server import ServerConnection, serve

    async def echo(connection: ServerConnection) -> None:
        async for message in connection:
            await connection.send(message)

    async with serve(echo, sock=listener, compression=None, max_size=None):
        await asyncio.get_running_loop().create_future()


def running_baseline_echo() -> AbstractContextManager[str]:
    """Run it in a process of its own; the context is its URL."""
    return running_peer("benchmarks.baseline_echo")


if __name__ == "__main__":
    asyncio.run(_serve(inherited_listener()))
