"""Baseline of the bus benchmark: the same bytes to as many connections, and no broker.

It takes NATS's PUB from one connection, and writes MSG to all that have subscribed, whatever the
subject. One that does not read has its own bytes kept, and nobody waits for it.
"""

import asyncio
import socket
from contextlib import AbstractContextManager
from typing import Final, cast

from benchmarks.peer_process import inherited_listener, running_peer

LIMIT_BYTES: Final = 64 << 20
"""What is kept for one connection before it is cut; as of NATS."""


def running_baseline_fan_out() -> AbstractContextManager[str]:
    """Run it in a process of its own; the context is its URL."""
    return running_peer("benchmarks.baseline_fan_out")


class _Connection(asyncio.Protocol):
    """One connection: publishes, or reads."""

    readers: Final[set["_Connection"]] = set()

    def __init__(self) -> None:
        self._data = bytearray()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        self.transport.write(b'INFO {"version":"2.9.0","max_payload":8388608}\r\n')

    def connection_lost(self, _error: Exception | None) -> None:
        self.readers.discard(self)

    def data_received(self, data: bytes) -> None:
        self._data += data
        while (end := self._data.find(b"\r\n")) >= 0:
            words = bytes(self._data[:end]).split(b" ")
            begin = end + 2
            if words[0] == b"PUB":
                size = int(words[-1])
                if len(self._data) < begin + size + 2:
                    return
                message = b"MSG %b 1 %d\r\n%b" % (
                    words[1], size, bytes(self._data[begin : begin + size + 2]),
                )  # fmt: skip
                for one in tuple(self.readers):
                    one.send(message)
                begin += size + 2
            elif words[0] == b"SUB":
                self.readers.add(self)
            elif words[0] == b"PING":
                self.transport.write(b"PONG\r\n")
            del self._data[:begin]

    def send(self, message: bytes) -> None:
        """Send a message, unless too much waits already."""
        if self.transport.get_write_buffer_size() > LIMIT_BYTES:
            self.readers.discard(self)
            self.transport.abort()
        else:
            self.transport.write(message)


async def _serve(listener: socket.socket) -> None:
    server = await asyncio.get_running_loop().create_server(_Connection, sock=listener)
    await server.serve_forever()


if __name__ == "__main__":
    import uvloop

    uvloop.run(_serve(inherited_listener()))
