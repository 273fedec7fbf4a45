"""Subscribers of a bus: many connections that read all, and some that never read.

They speak the little of NATS's protocol that subscribers need, so that one process reads for
hundreds. Each message begins with the envelope of the bus: its number shows what is missing, and
when it was sent is by the monotonic clock of this machine.
"""

import json
import select
import socket
import sys
import time
from typing import Final

import msgpack
import numpy as np

BUFFER_BYTES: Final = 1 << 20
IDLE_S: Final = 2.0
"""Nothing has come for so long: that was all."""
AT_MOST_S: Final = 60.0
SAMPLES: Final = 50_000
HEADER_BYTES: Final = 96
"""Of a message: its header, within which its number and its time are."""


class Subscriber:
    """One connection: counts messages, and those that are missing."""

    def __init__(self, address: tuple[str, int], subject: str) -> None:
        self.socket = socket.create_connection(address)
        hello = b'CONNECT {"verbose":false,"pedantic":false,"echo":false}\r\n'
        self.socket.sendall(hello + f"SUB {subject} 1\r\nPING\r\n".encode())
        self.socket.setblocking(False)
        self.messages = self.missed = 0
        self.closed = False
        self._number: int | None = None
        self._rest = b""
        """Bytes of a line, or of a message's begin, that are not whole yet."""
        self._skip = 0
        """Bytes of a message that are still to come, and that nobody looks at."""

    def read(self, buffer: bytearray, latencies: list[float]) -> None:
        """Take what is there."""
        while True:
            try:
                size = self.socket.recv_into(buffer)
            except BlockingIOError:
                return
            except OSError:
                size = 0
            if size == 0:
                self.closed = True
                return
            self._take(memoryview(buffer)[:size], latencies)
            if size < len(buffer):
                return

    def _take(self, data: memoryview, latencies: list[float]) -> None:
        at = 0
        while at < len(data):
            if self._skip:
                step = min(self._skip, len(data) - at)
                self._skip -= step
                at += step
                continue
            piece = self._rest + bytes(data[at : at + 4 * HEADER_BYTES])
            end = piece.find(b"\r\n")
            if end < 0:
                self._rest, at = piece, len(data)
                continue
            line = piece[:end]
            if not line.startswith(b"MSG "):
                if line == b"PING":
                    self.socket.send(b"PONG\r\n")
                at += end + 2 - len(self._rest)
                self._rest = b""
                continue
            size = int(line.rsplit(b" ", 1)[1])
            wanted = end + 2 + min(size, HEADER_BYTES)
            if len(piece) < wanted:
                self._rest, at = piece, len(data)
                continue
            self._look(piece[end + 2 : wanted], latencies)
            # What was looked at lies in this data or before it.
            self._skip = size + 2
            at += end + 2 - len(self._rest)
            self._rest = b""
            if at < 0:
                self._skip += at
                at = 0

    def _look(self, begin: bytes, latencies: list[float]) -> None:
        unpacker = msgpack.Unpacker()
        unpacker.feed(begin)
        unpacker.read_array_header()
        _, _, number, sent_s = (unpacker.unpack() for _ in range(4))
        if self._number is not None:
            self.missed += max(0, number - self._number - 1)
        self._number = number
        self.messages += 1
        latencies.append(time.monotonic() - sent_s)


def subscribe(
    address: tuple[str, int], subject: str, readers: int, stalled: int, seconds: float
) -> dict[str, object]:
    """Read for some seconds, and what comes late; return counts, and a sample of latencies [s]."""
    still = [Subscriber(address, subject) for _ in range(stalled)]
    for one in still:
        one.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    all_of_them = [Subscriber(address, subject) for _ in range(readers)]
    poll = select.epoll()
    by_descriptor = {one.socket.fileno(): one for one in all_of_them}
    for descriptor in by_descriptor:
        poll.register(descriptor, select.EPOLLIN)
    buffer, latencies = bytearray(BUFFER_BYTES), list[float]()
    print("ready", flush=True)
    end = heard = time.monotonic() + seconds
    while (now := time.monotonic()) < end or (now < heard + IDLE_S and now < end + AT_MOST_S):
        for descriptor, _ in poll.poll(0.1):
            one, before = by_descriptor[descriptor], len(latencies)
            one.read(buffer, latencies)
            if len(latencies) > before:
                heard = time.monotonic()
            if one.closed:
                poll.unregister(descriptor)
    kept = np.array(latencies)
    if len(kept) > SAMPLES:
        kept = np.random.default_rng(0).choice(kept, SAMPLES, replace=False)
    return {
        "messages": sum(one.messages for one in all_of_them),
        "missed": sum(one.missed for one in all_of_them),
        "cut": sum(one.closed for one in all_of_them),
        "latencies_s": kept.tolist(),
    }


if __name__ == "__main__":
    host, port, subject, readers, stalled, seconds = sys.argv[1:]
    found = subscribe((host, int(port)), subject, int(readers), int(stalled), float(seconds))
    print(json.dumps(found), flush=True)
