"""Subscription: one client's reading position in a device's log, and what it missed."""

import asyncio
from dataclasses import dataclass
from typing import Final, Protocol

from service.protocols.stream.encoding import (
    Content,
    Encoding,
    Payload,
    bundle,
    encode,
    missed_message,
)
from service.protocols.stream.message_log import StreamLog, Variant

BUNDLE_FRAMES: Final = 512
"""Most frames in one message."""
_ENTRIES: Final = 64  # that are looked at in one go


@dataclass(frozen=True, slots=True)
class CursorItem:
    """A payload, and whether it holds frames: other messages are not paced."""

    payload: Payload
    frames: bool


class Cursor(Protocol):
    """Reading position that yields what a client is sent next."""

    def take(self, *, due: bool) -> CursorItem | None:
        """Return what is sent now, if anything; ``due``: whether it is time for frames."""
        ...


class SequentialCursor:
    """Every message in order; too far behind, it skips to the newest and says what was missed.

    Args:
        log: the device's.
        variant: of the messages.
        device_id: for what it says was missed.
        start: number of the first message wanted.
        lag_s: how much older than the newest the next message may be; None: only the length of
            the log limits it.
        bundled: whether frames that wait are sent together.
    """

    def __init__(
        self,
        log: StreamLog,
        variant: Variant,
        device_id: str,
        start: int,
        lag_s: float | None,
        *,
        bundled: bool,
    ) -> None:
        self._log = log
        self._variant = variant
        self._device_id = device_id
        self._next = start
        self._lag_s = lag_s
        self._bundled = bundled
        self._max_frames = BUNDLE_FRAMES if bundled else 1
        self._entries = BUNDLE_FRAMES if bundled else _ENTRIES
        self._missed = 0
        # A client that comes back gets all that there is, if it has the time.
        self._skipped = start >= log.oldest

    def take(self, *, due: bool) -> CursorItem | None:
        """Return what is sent now; nothing overtakes frames that are not due."""
        if not due:
            return None
        frames: list[Payload] = []
        while not frames and (entries := self._log.since(self._next, self._entries)):
            if entries[0].first > self._next and self._skip_to(entries[0].first):
                continue
            go_on = self._log.newest_frame if self._behind(entries[0].at_s) else 0
            for entry in entries:
                if entry.batch is not None:
                    self._pass(min(go_on, entry.end))
                    if self._next == entry.end:
                        continue
                if self._missed:
                    return self._missed_message()
                if not entry.is_for(self._variant):
                    self._next = entry.end
                    continue
                if entry.batch is None:
                    if frames:
                        return self._taken(frames)
                    self._next = entry.end
                    return CursorItem(entry.payload(self._variant, entry.first), frames=False)
                begin = self._next - entry.first
                part = entry.payloads(self._variant)[begin : begin + self._max_frames - len(frames)]
                frames += part
                self._next += len(part)
                if len(frames) == self._max_frames:
                    return self._taken(frames)
        return self._taken(frames) if frames else None

    def _skip_to(self, oldest: int) -> bool:
        """Go on behind messages that are not kept any more; whether what is there has changed.

        From the log's very end a client that is a little too slow would fall off at every message
        and get nothing else: a lossless one goes on from the middle.
        """
        again = self._skipped and self._lag_s is None
        self._skipped = True
        self._pass(max(oldest, self._log.middle) if again else oldest)
        return again

    def _behind(self, at_s: float) -> bool:
        return self._lag_s is not None and self._log.newest_s - at_s > self._lag_s

    def _pass(self, number: int) -> None:
        self._missed += max(0, number - self._next)
        self._next = max(number, self._next)

    def _missed_message(self) -> CursorItem:
        message = missed_message(self._device_id, self._missed, self._next - self._missed)
        self._log.missed += self._missed
        self._missed = 0
        return CursorItem(encode(message, self._variant[1]), frames=False)

    def _taken(self, frames: list[Payload]) -> CursorItem:
        if not self._bundled:
            return CursorItem(frames[0], frames=True)
        return CursorItem(bundle(self._device_id, frames, self._variant[1]), frames=True)


class LatestCursor:
    """The newest frame whenever one is due, and every message that is no frame.

    Args:
        log: the device's.
        variant: of the messages; without content there are no frames.
        start: number from which on messages that are no frames are wanted.
    """

    def __init__(self, log: StreamLog, variant: Variant, start: int) -> None:
        self._log = log
        self._variant = variant
        self._message = start
        self._frame = log.next

    def take(self, *, due: bool) -> CursorItem | None:
        """Return what is sent now."""
        message = self._log.message_since(self._message, self._variant)
        if message is not None:
            self._message = message.end
            if message.content is not None and message.content in self._variant[0]:
                # What it tells of has changed: frames before it are not of now.
                self._frame = max(self._frame, message.end)
            return CursorItem(message.payload(self._variant, message.first), frames=False)
        newest = self._log.newest
        if not due or not self._variant[0] or newest is None or newest.end <= self._frame:
            return None
        self._frame = newest.end
        return CursorItem(newest.payload(self._variant, newest.end - 1), frames=True)


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
        rate_hz: largest rate of frames [Hz], the newest each time; None: every frame.
        bundle_s: shortest time between messages of several frames [s]; None: each in a message
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
    """One client's position and pace in a log; made and used in one event loop."""

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
        """Wake the client for a new message; frames wake it only when they are due."""
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
