"""Hub: publishes to the streams; one message log for each device, and the clients that read it."""

from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import TYPE_CHECKING, Any

from hardware.driver import DeviceDescription
from service.pipeline.beam_hold_state import BeamHoldState
from service.pipeline.detection_stage import peak_method
from service.pipeline.frame_batch import FrameBatch
from service.protocols.stream.encoding import Content, status_message
from service.protocols.stream.message_log import BeamHoldMessage, StreamLog
from service.protocols.stream.stream_batch import StreamBatch
from service.protocols.stream.subscription import StreamRequest, Subscription

if TYPE_CHECKING:
    import asyncio

KEPT_MESSAGES = 10_000
"""Messages of each device that are kept for clients which are behind or come back."""
LAG_S = 1.0
"""How far a client that is not lossless may fall behind."""


class Hub:
    """StreamPublisher of the service: appends to the device's log, and never waits for a client."""

    def __init__(self, kept_messages: int = KEPT_MESSAGES, lag_s: float = LAG_S) -> None:
        """Make a hub; see KEPT_MESSAGES and LAG_S."""
        self._kept_messages = kept_messages
        self._lag_s = lag_s
        self._logs: dict[str, StreamLog] = {}
        self._clients: dict[str, tuple[Subscription, ...]] = {}
        self._lock = Lock()
        self.closed: str | None = None
        """Why all streams have ended; None: they have not."""

    def log(self, device_id: str) -> StreamLog:
        """Return the device's log, made when it is first asked for."""
        with self._lock:
            found = self._logs.get(device_id)
            if found is None:
                found = self._logs[device_id] = StreamLog(self._kept_messages)
            return found

    def subscribe(self, request: StreamRequest) -> Subscription:
        """Add a client; called in the event loop that takes its messages."""
        subscription = Subscription(request, self.log(request.device_id), self._lag_s)
        with self._lock:
            here = self._clients.get(request.device_id, ())
            self._clients[request.device_id] = (*here, subscription)
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Remove a client; may be called again."""
        device_id = subscription.request.device_id
        with self._lock:
            here = self._clients.get(device_id, ())
            self._clients[device_id] = tuple(one for one in here if one is not subscription)

    def subscribers(self, device_id: str) -> int:
        """Return the number of clients of a device."""
        return len(self._clients.get(device_id, ()))

    def publish_batch(self, batch: FrameBatch) -> None:
        """Put a batch of frames into the device's log; callable from any thread."""
        self.log(batch.device_id).append_batch(StreamBatch.of(batch))
        self._tell(batch.device_id, _wake_for_frames)

    def publish(
        self, device_id: str, message: dict[str, Any], content: Content | None = None
    ) -> None:
        """Put a message that is no frame into the device's log; callable from any thread.

        ``content``: only clients who asked for it get it; None: all.
        """
        self.log(device_id).append(message, content)
        self._tell(device_id, _wake)

    def publish_status(
        self,
        device_id: str,
        state: str,
        reason: str | None = None,
        link: str | None = None,
        description: DeviceDescription | None = None,
    ) -> None:
        """Tell all clients of a device its state, with the description of one that runs."""
        message = status_message(device_id, state, reason, link)
        if description is not None:
            message |= describe_message(description)
        self.publish(device_id, message)

    def publish_hold(self, device_id: str, now: BeamHoldState) -> None:
        """Tell the clients who asked for beam holds of a change of one."""
        self.publish(device_id, BeamHoldMessage(device_id, now), "holds")

    def end(self, device_id: str) -> None:
        """Tell all clients of a device that it was deleted, end their streams, forget the log."""
        self.publish_status(device_id, "deleted")
        self._tell(device_id, partial(_end, "the device was deleted", False))
        with self._lock:
            self._logs.pop(device_id, None)

    def close(self, reason: str) -> None:
        """End all streams at once, though their devices go on."""
        self.closed = reason
        for device_id in tuple(self._clients):
            self._tell(device_id, partial(_end, reason, True))

    @property
    def clients(self) -> int:
        """How many clients there are."""
        return sum(len(here) for here in tuple(self._clients.values()))

    def logs(self) -> dict[str, StreamLog]:
        """Return the logs of all devices that have one."""
        with self._lock:
            return dict(self._logs)

    def _tell(self, device_id: str, action: Callable[[tuple[Subscription, ...]], None]) -> None:
        """Call an action with the device's clients in their loop, once for all of them."""
        loops: dict[asyncio.AbstractEventLoop, list[Subscription]] = {}
        for client in self._clients.get(device_id, ()):
            loops.setdefault(client.loop, []).append(client)
        for loop, clients in loops.items():
            try:
                loop.call_soon_threadsafe(action, tuple(clients))
            except RuntimeError:
                # The loop is closed: the service is ending and its clients are gone.
                continue


def describe_message(description: DeviceDescription) -> dict[str, Any]:
    """Return what a client needs to know of a running device, for hello and status messages."""
    return {
        "sensors": [sensor.name for sensor in description.sensors],
        "frame_rate_hz": description.frame_rate_hz,
        "markers": description.markers,
        "readout": description.readout,
        "method": peak_method(description),
    }


def _wake_for_frames(clients: tuple[Subscription, ...]) -> None:
    for client in clients:
        client.wake(frames=True)


def _wake(clients: tuple[Subscription, ...]) -> None:
    for client in clients:
        client.wake(frames=False)


def _end(reason: str, at_once: bool, clients: tuple[Subscription, ...]) -> None:
    for client in clients:
        client.end(reason, at_once=at_once)
