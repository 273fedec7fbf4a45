"""Hub: publishes to the streams; Subscription: one client of a stream."""

import asyncio
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any

from hardware.driver import DeviceDescription
from service.pipeline.frame_batch import BeamHoldState, FrameBatch
from service.pipeline.threads import call_in_loop
from service.protocols.stream.message_log import LatestCursor, SequentialCursor, StreamLog
from service.protocols.stream.messages import (
    BatchSource,
    Content,
    Encoding,
    Payload,
    StreamBatch,
    UnreadBatch,
    describe_message,
    hold_message,
    state_message,
)

KEPT_MESSAGES = 10_000
"""Messages of each device that are kept for clients which are behind or come back."""
LAG_S = 1.0
"""How far a client that is not lossless may fall behind."""


class StreamEnded(Exception):
    """There will be no more messages; its text says why."""


@dataclass(frozen=True)
class StreamRequest:
    """Request of a client for a device's stream.

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


class Subscription:
    """One client's position and pace in a log; made and used in one event loop.

    It begins with the next message, or after the one that the client has.
    """

    def __init__(
        self, request: StreamRequest, log: StreamLog, lag_s: float, client: str = ""
    ) -> None:
        self.request = request
        self.client = client
        self.opened_s = time.time()
        """When it was opened, since 1970 [s]."""
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
        self._cursor: LatestCursor | SequentialCursor
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
        self._pace_s = 1.0 / request.rate_hz if request.rate_hz else request.bundle_s or 0.0
        self._due_s = self.loop.time()
        self._ready = asyncio.Event()
        self._ended: str | None = None
        self._at_once = False

    @property
    def missed(self) -> int:
        """Messages that the client was too slow for."""
        return self._cursor.missed

    @property
    def waiting(self) -> int:
        """Messages that wait for the client; read from any thread, and a little old."""
        return self._cursor.waiting

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
            payload = self._take(now)
            if payload is not None:
                return payload
            if self._ended is not None:
                raise StreamEnded(self._ended)
            if now >= self._due_s:
                await self._ready.wait()
                continue
            with suppress(TimeoutError):
                async with asyncio.timeout(self._due_s - now):
                    await self._ready.wait()

    def next_at_once(self) -> Payload | None:
        """Return the next payload if it is there and due."""
        if self._ended is not None and self._at_once:
            return None
        return self._take(self.loop.time())

    def _take(self, now: float) -> Payload | None:
        item = self._cursor.take(due=now >= self._due_s or self._ended is not None)
        if item is None:
            return None
        if item.frames and self._pace_s:
            # Counted from when it was due, so that the rate is the one asked for; after a
            # pause from now, which is not made up for.
            self._due_s = max(self._due_s + self._pace_s, now)
        return item.payload


ClientListener = Callable[[str, int], None]


class Hub:
    """StreamPublisher of the service: appends to the device's log, and never waits for a client."""

    congested = False

    def __init__(self, kept_messages: int = KEPT_MESSAGES, lag_s: float = LAG_S) -> None:
        self._kept_messages = kept_messages
        self._lag_s = lag_s
        self._logs: dict[str, StreamLog] = {}
        self._clients: dict[str, tuple[Subscription, ...]] = {}
        self._lock = Lock()
        self.closed: str | None = None
        """Why all streams have ended; None: they have not."""
        self._client_listeners: list[ClientListener] = []

    def on_clients(self, listener: ClientListener) -> None:
        """Call with a device and its number of clients whenever that changes."""
        self._client_listeners.append(listener)

    def client_counts(self) -> dict[str, int]:
        """Return the number of clients of each device that had any."""
        return {device_id: len(here) for device_id, here in tuple(self._clients.items())}

    def _tell_clients(self, device_id: str) -> None:
        for listener in self._client_listeners:
            listener(device_id, self.subscribers(device_id))

    def log(self, device_id: str) -> StreamLog:
        """Return the device's log, made when it is first asked for."""
        with self._lock:
            if device_id not in self._logs:
                self._logs[device_id] = StreamLog(self._kept_messages)
            return self._logs[device_id]

    def logs(self) -> dict[str, StreamLog]:
        """Return the logs of all devices that have one."""
        with self._lock:
            return dict(self._logs)

    def subscribe(self, request: StreamRequest, client: str = "") -> Subscription:
        """Add a client by its name; called in the event loop that sends its messages."""
        subscription = Subscription(request, self.log(request.device_id), self._lag_s, client)
        with self._lock:
            here = self._clients.get(request.device_id, ())
            self._clients[request.device_id] = (*here, subscription)
        self._tell_clients(request.device_id)
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Remove a client; may be called again."""
        device_id = subscription.request.device_id
        with self._lock:
            here = self._clients.get(device_id, ())
            self._clients[device_id] = tuple(one for one in here if one is not subscription)
        self._tell_clients(device_id)

    def subscribers(self, device_id: str) -> int:
        """Return the number of clients of a device."""
        return len(self._clients.get(device_id, ()))

    def subscriptions(self) -> list[Subscription]:
        """Return all clients there are."""
        return [one for here in tuple(self._clients.values()) for one in here]

    @property
    def clients(self) -> int:
        """Number of clients."""
        return sum(len(here) for here in tuple(self._clients.values()))

    def publish_batch(self, batch: FrameBatch) -> None:
        """Put a batch of frames into the device's log; callable from any thread."""
        kept = StreamBatch(batch)
        kept.compact_peaks()
        self._append_batch(batch.device_id, kept)

    def publish_message(self, message: BatchSource) -> None:
        """Put a batch into the device's log that is read when a client wants it."""
        self._append_batch(message.device_id, UnreadBatch(message))

    def _append_batch(self, device_id: str, batch: StreamBatch | UnreadBatch) -> None:
        self.log(device_id).append_batch(batch)
        self._call_clients(device_id, partial(Subscription.wake, frames=True))

    def publish(self, device_id: str, message: dict[str, Any]) -> None:
        """Put a message that is no frame into the device's log; callable from any thread."""
        self.log(device_id).append(lambda: message)
        self._call_clients(device_id, partial(Subscription.wake, frames=False))

    def publish_status(
        self,
        device_id: str,
        state: str,
        reason: str | None = None,
        link: str | None = None,
        description: DeviceDescription | None = None,
    ) -> None:
        """Tell all clients of a device its state, with the description of one that runs."""
        message = state_message(device_id, state, reason, link)
        self.publish(device_id, message | (describe_message(description) if description else {}))

    def publish_hold(self, device_id: str, now: BeamHoldState) -> None:
        """Tell the clients who asked for beam holds of a change of one."""
        releases = (now.release,) if now.release else ()
        self.log(device_id).append(partial(hold_message, device_id, now), "holds", releases)
        self._call_clients(device_id, partial(Subscription.wake, frames=False))

    def end(self, device_id: str) -> None:
        """Tell all clients of a device that it was deleted, end their streams, forget the log."""
        self.publish_status(device_id, "deleted")
        end = partial(Subscription.end, reason="the device was deleted", at_once=False)
        self._call_clients(device_id, end)
        with self._lock:
            self._logs.pop(device_id, None)

    def close(self, reason: str) -> None:
        """End all streams at once, though their devices go on."""
        self.closed = reason
        for device_id in tuple(self._clients):
            self._call_clients(device_id, partial(Subscription.end, reason=reason, at_once=True))

    def _call_clients(self, device_id: str, action: Callable[[Subscription], None]) -> None:
        """Call an action with each of the device's clients in its loop, once for each loop."""
        loops: dict[asyncio.AbstractEventLoop, list[Subscription]] = defaultdict(list)
        for client in self._clients.get(device_id, ()):
            loops[client.loop].append(client)
        for loop, clients in loops.items():
            if asyncio._get_running_loop() is loop:
                _call_each(action, clients)
            else:
                call_in_loop(loop, _call_each, action, clients)


def _call_each(action: Callable[[Subscription], None], clients: list[Subscription]) -> None:
    for client in clients:
        action(client)
