"""StreamLog: the newest messages of one device, numbered, for clients that read at their pace."""

import math
import secrets
import time
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field
from itertools import islice
from threading import Lock
from typing import Any

from service.pipeline.beam_hold_state import BeamEnableToken, BeamHoldState
from service.protocols.stream.encoding import Content, Encoding, Payload, encode, frame_messages
from service.protocols.stream.stream_batch import StreamBatch, hold_members

Variant = tuple[frozenset[Content], Encoding]
"""What messages hold, and how they are written: clients of the same variant share the work."""


class BeamHoldMessage(dict[str, Any]):
    """Message about a change of a beam hold; ``sent`` is what it says at the time of sending."""

    def __init__(self, device_id: str, now: BeamHoldState) -> None:
        super().__init__(
            {
                "type": "hold",
                "device": device_id,
                **hold_members(now),
                "exposure_ns": now.exposure_ns,
                "sequence": now.sequence,
            }
        )
        self.now = now

    @property
    def sent(self) -> dict[str, Any]:
        """Its members; held, where the beam was held since the change."""
        return {**self, **hold_members(self.now)}


@dataclass(eq=False, slots=True)
class LogEntry:
    """Messages that came together: one for each frame of a batch, or a single other one.

    Encoded when a client first asks, in the event loop, and kept for the others; again when a
    beam that it says is not held was held since.

    Args:
        first: number of the first message.
        count: how many.
        at_s: when they came (``time.monotonic``).
        batch: the frames; None: ``message`` is the one message.
        message: a status message.
        content: that of clients who are to get the message; None: all are.
    """

    first: int
    count: int
    at_s: float
    batch: StreamBatch | None = None
    message: dict[str, Any] | None = None
    content: Content | None = None
    _all: dict[Variant, tuple[int, list[Payload]]] = field(default_factory=dict)
    _single: dict[tuple[Variant, int], tuple[int, Payload]] = field(default_factory=dict)

    @property
    def end(self) -> int:
        """The number after the last message's."""
        return self.first + self.count

    def is_for(self, variant: Variant) -> bool:
        """Whether clients of a variant get it."""
        return self.content is None or self.content in variant[0]

    def payloads(self, variant: Variant) -> list[Payload]:
        """Return all messages, encoded."""
        over = self._over
        known, found = self._all.get(variant, (-1, []))
        if known != over:
            found = self._encoded(variant, 0, self.count)
            self._all[variant] = over, found
        return found

    def payload(self, variant: Variant, number: int) -> Payload:
        """Return one message, encoded; the others of a batch are not touched."""
        index = number - self.first
        over = self._over
        known = self._all.get(variant)
        if known is not None and known[0] == over:
            return known[1][index]
        single = self._single.get((variant, index))
        if single is not None and single[0] == over:
            return single[1]
        (found,) = self._encoded(variant, index, index + 1)
        self._single[variant, index] = over, found
        return found

    @property
    def _over(self) -> int:
        """How many of the releases that it tells of are over."""
        return sum(one.over for one in self._releases)

    @property
    def _releases(self) -> tuple[BeamEnableToken, ...]:
        if self.batch is not None:
            return self.batch.releases
        if isinstance(self.message, BeamHoldMessage) and self.message.now.release is not None:
            return (self.message.now.release,)
        return ()

    def _encoded(self, variant: Variant, first: int, last: int) -> list[Payload]:
        content, encoding = variant
        if self.batch is None:
            assert self.message is not None
            own = self.message
            messages = [own.sent if isinstance(own, BeamHoldMessage) else dict(own)]
        else:
            messages = frame_messages(self.batch, content, first, last)
        for number, message in enumerate(messages, self.first + first):
            message["n"] = number
        return [encode(message, encoding) for message in messages]


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
        self._capacity = capacity
        self._entries: deque[LogEntry] = deque()
        self._messages: deque[LogEntry] = deque()
        self._held = 0
        self.missed = 0
        """Messages that clients were told to have missed, of all clients together."""
        self._lock = Lock()

    @property
    def oldest(self) -> int:
        """Number of the oldest message that is kept; ``next`` when there is none."""
        with self._lock:
            return self._entries[0].first if self._entries else self.next

    @property
    def middle(self) -> int:
        """Number of a message in the middle of those that are kept."""
        with self._lock:
            entries = self._entries
            return entries[len(entries) // 2].first if entries else self.next

    @property
    def held(self) -> int:
        """How many messages are kept now."""
        return self._held

    @property
    def newest_frame(self) -> int:
        """Number of the newest frame; -1 before the first."""
        newest = self.newest
        return -1 if newest is None else newest.end - 1

    def append_batch(self, batch: StreamBatch) -> None:
        """Add one message for each frame of a batch."""
        if batch.frames:
            self._append(len(batch.frames), batch, None)

    def append(self, message: dict[str, Any], content: Content | None = None) -> None:
        """Add a message that is no frame, for all clients, or those of a content."""
        own = message if isinstance(message, BeamHoldMessage) else dict(message)
        self._append(1, None, own, content)

    def _append(
        self,
        count: int,
        batch: StreamBatch | None,
        message: dict[str, Any] | None,
        content: Content | None = None,
    ) -> None:
        with self._lock:
            entry = LogEntry(self.next, count, time.monotonic(), batch, message, content)
            self._entries.append(entry)
            if batch is None:
                self._messages.append(entry)
            else:
                self.newest = entry
            self.newest_s = entry.at_s
            self.next = entry.end
            self._held += count
            # The newest stays, however large it is.
            while self._held > self._capacity and len(self._entries) > 1:
                gone = self._entries.popleft()
                self._held -= gone.count
                if gone.batch is None:
                    self._messages.popleft()

    def since(self, number: int, most: int) -> list[LogEntry]:
        """Return the oldest ``most`` entries of those that end behind this message's number."""
        with self._lock:
            if number >= self.next:
                return []
            entries = self._entries
            # A client that keeps up is at the end, which a deque finds quickest.
            start = len(entries) - 1
            if entries[start].first > number:
                start = bisect_right(entries, number, key=lambda entry: entry.end)
            return list(islice(entries, start, start + most))

    def message_since(self, number: int, variant: Variant) -> LogEntry | None:
        """Return the oldest message for a variant that is no frame, from this number on."""
        if not self._messages or self._messages[-1].first < number:
            return None
        with self._lock:
            return next(
                (one for one in self._messages if one.first >= number and one.is_for(variant)), None
            )
