"""StreamLog: the newest messages of one device, numbered; cursors: where a client reads in it."""

import math
import secrets
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from threading import Lock
from typing import Final, NamedTuple

from service.pipeline.frame_batch import BeamEnableToken
from service.protocols.stream.messages import (
    Content,
    Encoding,
    Payload,
    Rows,
    StreamBatch,
    UnreadBatch,
    bundle,
    encode,
    missed_message,
)

BUNDLE_FRAMES: Final = 512
"""Most frames in one message."""
_ENTRIES: Final = 64  # that are looked at, or forgotten, in one go
_END: Final = attrgetter("end")

Variant = tuple[frozenset[Content], Encoding]
"""What messages hold, and how they are written: clients of the same variant share the work."""


@dataclass(eq=False, slots=True)
class LogEntry:
    """Messages that came together: one for each frame of a batch, or a single other one.

    Encoded when a client first asks, in the event loop, and kept for the others; again when a
    beam that it says is not held was held since.

    Args:
        first: number of the first message.
        count: how many.
        at_s: when they came (``time.monotonic``).
        messages: returns those of a content, from an index to before another.
        frames: whether they are frames.
        releases: tokens of the holds whose beam they say is enabled.
        content: that of clients who are to get the message; None: all are.
    """

    first: int
    count: int
    at_s: float
    messages: Callable[[frozenset[Content], int, int], Rows]
    frames: bool
    releases: tuple[BeamEnableToken, ...] = ()
    content: Content | None = None
    _encoded: dict[Variant | tuple[Variant, int], tuple[int, tuple[Payload, ...]]] | None = None
    """What was encoded: all messages of a variant, or one by its index, and of how many releases
    that were over then. Made late: most are kept without ever being asked for."""

    @property
    def end(self) -> int:
        """The number after the last message's."""
        return self.first + self.count

    def is_for(self, variant: Variant) -> bool:
        """Whether clients of a variant get it."""
        return self.content is None or self.content in variant[0]

    def payloads(self, variant: Variant) -> tuple[Payload, ...]:
        """Return all messages, encoded."""
        return self._payloads(variant, variant, 0, self.count)

    def payload(self, variant: Variant, number: int) -> Payload:
        """Return one message, encoded; the others of a batch are not touched."""
        index = number - self.first
        found = self._known(variant)
        if found is not None:
            return found[index]
        (single,) = self._payloads((variant, index), variant, index, index + 1)
        return single

    def _payloads(
        self, key: Variant | tuple[Variant, int], variant: Variant, first: int, last: int
    ) -> tuple[Payload, ...]:
        payloads = self._known(key)
        if payloads is None:
            over = self._over
            payloads = self._encode(variant, first, last)
            if self._encoded is None:
                self._encoded = {}
            self._encoded[key] = over, payloads
        return payloads

    def _known(self, key: Variant | tuple[Variant, int]) -> tuple[Payload, ...] | None:
        """Return what was encoded since the last release was over, if it was."""
        if self._encoded is None:
            return None
        over, payloads = self._encoded.get(key, (-1, None))
        return payloads if over == self._over else None

    @property
    def _over(self) -> int:
        """Number of its releases that are over."""
        return sum(one.over for one in self.releases)

    def _encode(self, variant: Variant, first: int, last: int) -> tuple[Payload, ...]:
        content, encoding = variant
        messages = self.messages(content, first, last)
        return tuple(
            [
                encode(message | {"n": number}, encoding)
                for number, message in enumerate(messages, self.first + first)
            ]
        )


class StreamLog:
    """Keeps at most ``capacity`` messages of a device; older ones go, whole batches at a time.

    Appended to by any thread, read by any. Messages are numbered from 0 without a gap; ``id``
    tells this log from the one before a restart of the service, whose numbers mean nothing here.
    """

    def __init__(self, capacity: int) -> None:
        self.id = secrets.token_hex(8)
        self.next = 0
        """Number that the next message will have."""
        self.newest: LogEntry | None = None
        """The newest frames."""
        self.newest_s = -math.inf
        """When the newest message came (``time.monotonic``)."""
        self.message_count = 0
        """How many messages are kept now."""
        self.missed = 0
        """Messages that clients were told to have missed, of all clients together."""
        self._capacity = capacity
        # A list, for a client far behind to find its place at once: a deque walks there.
        self._entries: list[LogEntry] = []
        self._begin = 0  # where the kept ones begin
        self._others: deque[LogEntry] = deque()  # those that are no frames
        self._lock = Lock()

    @property
    def oldest(self) -> int:
        """Number of the oldest message that is kept; ``next`` when there is none."""
        with self._lock:
            return self._entries[self._begin].first if self._entries else self.next

    @property
    def middle(self) -> int:
        """Number of a message in the middle of those that are kept."""
        with self._lock:
            entries = self._entries
            middle = (self._begin + len(entries)) // 2
            return entries[middle].first if entries else self.next

    @property
    def newest_frame(self) -> int:
        """Number of the newest frame; -1 before the first."""
        newest = self.newest
        return -1 if newest is None else newest.end - 1

    def append_batch(self, batch: StreamBatch | UnreadBatch) -> None:
        """Add one message for each frame of a batch."""
        if batch.count:
            self._append(batch.count, batch.messages, frames=True, releases=batch.releases)

    def append(
        self,
        message: Callable[[], dict[str, object]],
        content: Content | None = None,
        releases: tuple[BeamEnableToken, ...] = (),
    ) -> None:
        """Add a message that is no frame.

        Args:
            message: returns what it says when it is sent.
            content: that of clients who are to get it; None: all are.
            releases: tokens of the holds whose beam it says is enabled.
        """
        self._append(1, lambda *_: [message()], frames=False, releases=releases, content=content)

    def _append(
        self,
        count: int,
        messages: Callable[[frozenset[Content], int, int], Rows],
        *,
        frames: bool,
        releases: tuple[BeamEnableToken, ...],
        content: Content | None = None,
    ) -> None:
        with self._lock:
            entry = LogEntry(
                self.next, count, time.monotonic(), messages, frames, releases, content
            )
            self._entries.append(entry)
            if frames:
                self.newest = entry
            else:
                self._others.append(entry)
            self.newest_s = entry.at_s
            self.next = entry.end
            self.message_count += count
            # The newest stays, however large it is.
            last = len(self._entries) - 1
            while self.message_count > self._capacity and self._begin < last:
                self._drop_oldest()
            if self._begin >= _ENTRIES:
                del self._entries[: self._begin]
                self._begin = 0

    def _drop_oldest(self) -> None:
        oldest = self._entries[self._begin]
        self._begin += 1
        self.message_count -= oldest.count
        if not oldest.frames:
            self._others.popleft()

    def since(self, number: int, limit: int) -> list[LogEntry]:
        """Return the oldest ``limit`` entries of those that end behind this message's number."""
        with self._lock:
            if number >= self.next:
                return []
            entries = self._entries
            start = len(entries) - 1  # where a client that keeps up is
            if entries[start].first > number:
                start = bisect_right(entries, number, self._begin, key=_END)
            return entries[start : start + limit]

    def other_since(self, number: int, variant: Variant) -> LogEntry | None:
        """Return the oldest message for a variant that is no frame, from this number on."""
        if not self._others or self._others[-1].first < number:
            return None
        with self._lock:
            return next(
                (one for one in self._others if one.first >= number and one.is_for(variant)), None
            )


class CursorItem(NamedTuple):
    """A payload, and whether it holds frames: other messages are not paced."""

    payload: Payload
    frames: bool


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
        self._max_frames, self._entries = (
            (BUNDLE_FRAMES, BUNDLE_FRAMES) if bundled else (1, _ENTRIES)
        )
        self._missed = 0
        self.missed = 0
        """Messages that its client was told to have missed."""
        # A client that comes back gets all that there is, if it has the time.
        self._skipped = start >= log.oldest

    @property
    def waiting(self) -> int:
        """Number of messages that its client was not sent yet."""
        return max(0, self._log.next - self._next)

    def take(self, *, due: bool) -> CursorItem | None:
        """Return the messages to send now, if any; nothing overtakes frames that are not due."""
        if not due:
            return None
        frames: list[Payload] = []
        while not frames and (entries := self._log.since(self._next, self._entries)):
            if entries[0].first > self._next and self._skip_to(entries[0].first):
                continue
            behind = self._lag_s is not None and self._log.newest_s - entries[0].at_s > self._lag_s
            resume_at = self._log.newest_frame if behind else 0
            for entry in entries:
                if entry.frames:
                    self._pass(min(resume_at, entry.end))
                    if self._next == entry.end:
                        continue
                if self._missed:
                    return self._missed_message()
                if not entry.is_for(self._variant):
                    self._next = entry.end
                    continue
                if not entry.frames:
                    if frames:
                        return self._join(frames)
                    self._next = entry.end
                    return CursorItem(entry.payload(self._variant, entry.first), frames=False)
                begin = self._next - entry.first
                part = entry.payloads(self._variant)[begin : begin + self._max_frames - len(frames)]
                frames += part
                self._next += len(part)
                if len(frames) == self._max_frames:
                    return self._join(frames)
        return self._join(frames) if frames else None

    def _skip_to(self, oldest: int) -> bool:
        """Skip messages that are not kept any more; return whether the entries have changed.

        From the log's very end a client that is a little too slow would fall off at every message
        and get nothing else: a lossless one goes on from the middle.
        """
        again = self._skipped and self._lag_s is None
        self._skipped = True
        self._pass(max(oldest, self._log.middle) if again else oldest)
        return again

    def _pass(self, number: int) -> None:
        self._missed += max(0, number - self._next)
        self._next = max(number, self._next)

    def _missed_message(self) -> CursorItem:
        message = missed_message(self._device_id, self._missed, self._next - self._missed)
        self._log.missed += self._missed
        self.missed += self._missed
        self._missed = 0
        return CursorItem(encode(message, self._variant[1]), frames=False)

    def _join(self, frames: list[Payload]) -> CursorItem:
        payload = bundle(self._device_id, frames, self._variant[1]) if self._bundled else frames[0]
        return CursorItem(payload, frames=True)


class LatestCursor:
    """The newest frame whenever one is due, and every message that is no frame.

    Its client is never behind: what it does not get, it did not want.
    """

    missed: Final = 0
    waiting: Final = 0

    def __init__(self, log: StreamLog, variant: Variant, start: int) -> None:
        self._log = log
        self._variant = variant
        self._other = start
        self._frame = log.next

    def take(self, *, due: bool) -> CursorItem | None:
        """Return the message to send now, if any; ``due``: whether it is time for frames."""
        other = self._log.other_since(self._other, self._variant)
        if other is not None:
            self._other = other.end
            if other.content is not None:
                # What it tells of has changed: frames before it are not of now.
                self._frame = max(self._frame, other.end)
            return CursorItem(other.payload(self._variant, other.first), frames=False)
        newest = self._log.newest
        if not due or not self._variant[0] or newest is None or newest.end <= self._frame:
            return None
        self._frame = newest.end
        return CursorItem(newest.payload(self._variant, newest.end - 1), frames=True)
