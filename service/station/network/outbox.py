"""Outbox: what a station says to other machines, numbered by subject, and sent without waiting.

Frames of a device are collected for some milliseconds and go together; poses, holds and states go
at once. Where the broker does not take them, or there is none, the oldest are thrown away: the
numbers show it, and the station goes on.
"""

import asyncio
import time
from collections import defaultdict, deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from service.station.network.connection import BACKLOG_BYTES, BusConnection
from service.station.network.envelope import Envelope, pack
from service.station.network.messages import Positions
from service.station.network.subjects import BATCH, subject

COMPRESSED_BYTES: Final = 1024
"""Frames of so many bytes are compressed: most of a frame is room for peaks that it has not."""
MAX_FRAMES: Final = 50
"""Frames that go together at most."""
QUEUE_BYTES: Final = 16 << 20
"""What may wait for the connection."""
_PAUSE_S: Final = 0.002


@dataclass
class _Collected:
    messages: list[bytes] = field(default_factory=list)
    frames: int = 0
    timer: asyncio.TimerHandle | None = None


class Outbox:
    """Numbers and sends messages; used in one event loop.

    Args:
        station: its name.
        incarnation: of it.
        connection: sends them.
        delay_s: how long a frame waits for others to go with it [s].
    """

    def __init__(
        self, station: str, incarnation: str, connection: BusConnection, delay_s: float
    ) -> None:
        self._station = station
        self.incarnation = incarnation
        self._connection = connection
        self._delay_s = delay_s
        self._numbers: dict[tuple[str, ...], int] = defaultdict(int)
        self._collected: dict[tuple[str, ...], _Collected] = defaultdict(_Collected)
        self._queue: deque[tuple[str, bytes]] = deque()
        self._queued_bytes = 0
        self.dropped = 0
        """Messages that were thrown away, as nobody took them."""
        self._wake = asyncio.Event()
        self._task = asyncio.get_running_loop().create_task(self._send())

    def put(self, words: tuple[str, ...], *messages: bytes) -> None:
        """Send messages together, at once.

        Args:
            words: of the subject behind the station: kind, and device where there is one.
            messages: of the bus.
        """
        number = self._numbers[words]
        envelope = Envelope(self.incarnation, number, time.monotonic(), messages)
        compressed = words[0] == BATCH and sum(map(len, messages)) >= COMPRESSED_BYTES
        parts = pack(envelope, self._connection.max_payload, compressed=compressed)
        self._numbers[words] = number + len(parts)
        if not self._connection.connected:
            self.dropped += len(parts)
            return
        name = subject(self._station, *words)
        for part in parts:
            self._queue.append((name, part))
            self._queued_bytes += len(part)
        while self._queued_bytes > QUEUE_BYTES:
            self._queued_bytes -= len(self._queue.popleft()[1])
            self.dropped += 1
        self._wake.set()

    def collect(self, words: tuple[str, ...], message: bytes, frames: int) -> None:
        """Send a message with the next ones of its subject, within the delay."""
        collected = self._collected[words]
        collected.messages.append(message)
        collected.frames += frames
        if collected.frames >= MAX_FRAMES or self._delay_s <= 0.0:
            self.flush(words)
        elif collected.timer is None:
            loop = asyncio.get_running_loop()
            collected.timer = loop.call_later(self._delay_s, self.flush, words)

    def flush(self, words: tuple[str, ...]) -> None:
        """Send what was collected for a subject."""
        collected = self._collected.pop(words, None)
        if collected is None:
            return
        if collected.timer is not None:
            collected.timer.cancel()
        if collected.messages:
            self.put(words, *collected.messages)

    def flush_all(self) -> None:
        """Send all that was collected."""
        for words in tuple(self._collected):
            self.flush(words)

    @property
    def waiting(self) -> int:
        """Messages that wait for the connection to take them."""
        return len(self._queue)

    @property
    def positions(self) -> Positions:
        """Numbers of the newest messages, by the words of their subjects."""
        return {".".join(words): number - 1 for words, number in self._numbers.items()}

    async def close(self) -> None:
        """Send what waits, for a moment, and end."""
        self.flush_all()
        with suppress(TimeoutError):
            async with asyncio.timeout(1.0):
                while self._queue and self._connection.connected:
                    await asyncio.sleep(_PAUSE_S)
        self._task.cancel()
        with suppress(asyncio.CancelledError):
            await self._task

    async def _send(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._queue:
                if not self._connection.connected:
                    self.dropped += len(self._queue)
                    self._queue.clear()
                    self._queued_bytes = 0
                elif self._connection.backlog > BACKLOG_BYTES:
                    await asyncio.sleep(_PAUSE_S)
                else:
                    name, part = self._queue.popleft()
                    self._queued_bytes -= len(part)
                    await self._connection.publish(name, part)
