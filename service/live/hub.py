"""The hub: hands what the compute thread publishes to every stream, without waiting for any."""

import asyncio
from collections import deque
from collections.abc import Callable, Iterable
from threading import Lock
from typing import Any

from service.live.batch import FrameBatch
from service.live.messages import (
    Content,
    Encoding,
    Payload,
    encode,
    frame_messages,
    missed_message,
)


class StreamEnded(Exception):
    """There will be no more messages."""


class Subscription:
    """One client's bounded queue. When it is full the oldest is dropped, counted and told."""

    def __init__(
        self,
        device_id: str,
        content: frozenset[Content],
        encoding: Encoding,
        capacity: int,
    ) -> None:
        """Create it in the event loop that takes the messages, at most ``capacity`` waiting."""
        self.device_id = device_id
        self.content = content
        self.encoding = encoding
        self.loop = asyncio.get_running_loop()
        self.missed = 0
        self._capacity = capacity
        self._queue: deque[Payload] = deque()
        self._ready = asyncio.Event()
        self._ended = False

    def offer(self, payloads: Iterable[Payload]) -> None:
        """Add messages; runs in the loop."""
        for payload in payloads:
            if len(self._queue) == self._capacity:
                self._queue.popleft()
                self.missed += 1
            self._queue.append(payload)
        self._ready.set()

    def end(self) -> None:
        """Let ``next`` raise StreamEnded after what waits; runs in the loop."""
        self._ended = True
        self._ready.set()

    async def next(self) -> Payload:
        """Return the next message, or how many were missed since the last.

        Raises:
            StreamEnded: the device was deleted and all its messages were taken.
        """
        while not self._queue:
            if self._ended:
                raise StreamEnded
            self._ready.clear()
            await self._ready.wait()
        if self.missed:
            message = missed_message(self.device_id, self.missed)
            self.missed = 0
            return encode(message, self.encoding)
        return self._queue.popleft()


class Hub:
    """Subscriptions by device; publishing encodes once for each kind of client."""

    def __init__(self) -> None:
        self._subscriptions: dict[str, list[Subscription]] = {}
        self._lock = Lock()

    def subscribe(self, subscription: Subscription) -> None:
        """Add a client; it receives what is published from now on."""
        with self._lock:
            self._subscriptions.setdefault(subscription.device_id, []).append(subscription)

    def unsubscribe(self, subscription: Subscription) -> None:
        """Remove a client."""
        with self._lock:
            self._subscriptions[subscription.device_id].remove(subscription)

    def subscribers(self, device_id: str) -> int:
        """Return the number of clients of a device."""
        return len(self._subscriptions.get(device_id, ()))

    def publish_batch(self, batch: FrameBatch) -> None:
        """Hand a batch of frames to the device's clients; callable from any thread."""
        messages: dict[frozenset[Content], list[dict[str, Any]]] = {}
        payloads: dict[tuple[frozenset[Content], Encoding], list[Payload]] = {}
        for client in self._clients(batch.device_id):
            key = (client.content, client.encoding)
            if key not in payloads:
                if client.content not in messages:
                    messages[client.content] = list(frame_messages(batch, client.content))
                payloads[key] = [
                    encode(message, client.encoding) for message in messages[client.content]
                ]
            _deliver(client, payloads[key])

    def publish(self, device_id: str, message: dict[str, Any]) -> None:
        """Hand one message to all of the device's clients; callable from any thread."""
        for client in self._clients(device_id):
            _deliver(client, [encode(message, client.encoding)])

    def end(self, device_id: str, message: dict[str, Any]) -> None:
        """Send all clients of a device a last message and end their streams."""
        self.publish(device_id, message)
        for client in self._clients(device_id):
            _call(client, client.end)

    def _clients(self, device_id: str) -> list[Subscription]:
        with self._lock:
            return list(self._subscriptions.get(device_id, ()))


def _deliver(client: Subscription, payloads: list[Payload]) -> None:
    _call(client, client.offer, payloads)


def _call(client: Subscription, action: Callable[..., None], *arguments: object) -> None:
    try:
        client.loop.call_soon_threadsafe(action, *arguments)
    except RuntimeError:
        # The loop is closed: the service is ending and the client is gone.
        return
