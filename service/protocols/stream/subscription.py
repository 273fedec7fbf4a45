"""Subscription: what one client asked for, and when it gets it."""

import asyncio
from dataclasses import dataclass

from service.protocols.stream.cursors import Cursor, LatestCursor, SequentialCursor
from service.protocols.stream.encoding import Content, Encoding, Payload
from service.protocols.stream.message_log import StreamLog


class StreamEnded(Exception):
    """There will be no more messages; its text says why."""


@dataclass(frozen=True)
class StreamRequest:
    """What a client asked for.

    Args:
        device_id: the device.
        content: what a frame's message holds; empty: no frames are sent.
        encoding: how messages are written.
        lossless: every message in order for as long as it is kept; otherwise a client that falls
            behind goes on with the newest.
        rate_hz: at most so many frames a second, the newest each time; None: every one.
        bundle_s: frames are sent together, at most every so many seconds; None: each in a message
            of its own.
        stream: the log that ``after`` is of.
        after: number of the last message that the client has; None: it begins with the next.
    """

    device_id: str
    content: frozenset[Content]
    encoding: Encoding
    lossless: bool = False
    rate_hz: float | None = None
    bundle_s: float | None = None
    stream: str | None = None
    after: int | None = None

    @property
    def pace_s(self) -> float:
        """Least time from one message with frames to the next."""
        return 1.0 / self.rate_hz if self.rate_hz is not None else self.bundle_s or 0.0


class Subscription:
    """One client's reading of a log; made and used in one event loop."""

    def __init__(self, request: StreamRequest, log: StreamLog, lag_s: float) -> None:
        """Begin with the next message, or after the one that the client has.

        Args:
            wanted: what the client asked for.
            log: the device's.
            lag_s: how far a client that is not lossless may fall behind.
        """
        self.request = request
        self.loop = asyncio.get_running_loop()
        self.log = log
        self.resumed = request.after is not None and request.stream == log.id
        """Whether it goes on behind the message that the client has."""
        self.start = log.next
        """Number of the first message that it is to get."""
        if request.after is not None:
            # The numbers of another log mean nothing here: all that there is, then.
            self.start = min(request.after + 1, log.next) if self.resumed else log.oldest
        variant = (request.content, request.encoding)
        self._cursor: Cursor
        if request.rate_hz is not None or not request.content:
            self._cursor = LatestCursor(log, variant, self.start)
        else:
            self._cursor = SequentialCursor(
                log,
                variant,
                request.device_id,
                self.start,
                None if request.lossless else lag_s,
                bundled=request.bundle_s is not None,
            )
        self._pace_s = request.pace_s
        self._due_s = self.loop.time()
        self._ready = asyncio.Event()
        self._ended: str | None = None
        self._at_once = False

    def wake(self, *, frames: bool) -> None:
        """Say that there is something new; frames wake nobody for whom they are not due."""
        if not frames or not self._pace_s or self.loop.time() >= self._due_s:
            self._ready.set()

    def end(self, reason: str, *, at_once: bool) -> None:
        """Let ``next`` raise StreamEnded: at once, or after what is there."""
        self._ended, self._at_once = reason, at_once
        self._ready.set()

    async def next(self) -> Payload:
        """Return the next payload; waits for it.

        Raises:
            StreamEnded: ``end`` was called.
        """
        while True:
            if self._ended is not None and self._at_once:
                raise StreamEnded(self._ended)
            self._ready.clear()
            now = self.loop.time()
            due = now >= self._due_s or self._ended is not None
            taken = self._cursor.take(due=due)
            if taken is not None:
                if taken.frames and self._pace_s:
                    # Counted from when it was due, so that the rate is the one asked for; after a
                    # pause from now, which is not made up for.
                    self._due_s = max(self._due_s + self._pace_s, now)
                return taken.payload
            if self._ended is not None:
                raise StreamEnded(self._ended)
            try:
                async with asyncio.timeout(None if due else self._due_s - now):
                    await self._ready.wait()
            except TimeoutError:
                continue
