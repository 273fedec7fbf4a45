"""Relay: passes what comes by a station's shared memory on to the bus between machines.

Batches and poses go on as they are. What the station's host changes of the rest (it holds beams
when its process is lost, and says that devices start again) goes on as the host tells it.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from hardware.driver import DeviceDescription
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import BeamHoldState, FrameBatch
from service.pipeline.threads import call_in_loop
from service.station.bus_messages import (
    BatchMessage,
    MessageKind,
    StationFigures,
    end_message,
    figures_message,
    hold_message,
    prepared_message,
    renewal_message,
    state_message,
    without_pixels,
)
from service.station.network.outbox import Outbox
from service.station.network.subjects import BATCH, HOLDS, PIXELS, POSES, STATE
from service.station.remote_device import CalibrationListener, RemoteDevice
from service.station.remote_pipeline import RemotePipeline

RENEWAL_S: Final = 0.005
"""Least time between two messages that say how long beams of a device stay enabled."""
FORGET_S: Final = 6.0
"""A gateway that has not asked for so long is gone: what it wanted, it wants no more."""
GENERATIONS: Final = 1 << 32
"""Starts of devices are numbered anew by each process: these come apart."""


@dataclass(eq=False)
class Gateway:
    """What a gateway wants of a station.

    Args:
        asked_s: when it last asked (``time.monotonic``).
        clients: of each device.
        taps: by number, with the device that each is attached to.
    """

    asked_s: float
    clients: dict[str, int] = field(default_factory=dict)
    taps: dict[int, tuple[RemoteDevice, "RelayTap"]] = field(default_factory=dict)


class Relay:
    """StreamPublisher of a station's host: tells other machines; see ``StreamPublisher``."""

    closed: str | None = None
    congested = False

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._loop = asyncio.get_running_loop()
        self._listeners: list[Callable[[str, int], None]] = []
        self._clients: Counter[str] = Counter()
        self.figures: Callable[[], StationFigures] | None = None
        """Figures that go before each change of a state."""
        self.pixels: Counter[str] = Counter()
        """Taps of other machines that want pixels, by device."""
        self._renewed_s: dict[str, float] = {}

    def put(self, words: tuple[str, ...], message: bytes) -> None:
        """Send a message at once; callable from any thread."""
        if asyncio._get_running_loop() is self._loop:
            self._outbox.put(words, message)
        else:
            call_in_loop(self._loop, self._outbox.put, words, message)

    def publish_batch(self, batch: FrameBatch) -> None:
        """Do nothing: batches come as messages."""

    def publish_message(self, message: BatchMessage) -> None:
        """Do nothing: ``relay`` has sent it."""

    def publish_hold(self, device_id: str, now: BeamHoldState) -> None:
        """Do nothing: the listener of the holds also knows which change is the last."""

    def put_hold(self, device_id: str, now: BeamHoldState, last: bool) -> None:
        """Send a change of a beam hold; a ``Listener``."""
        self.put((HOLDS,), hold_message(device_id, now, last=last))

    def publish_status(
        self,
        device_id: str,
        state: str,
        reason: str | None = None,
        link: str | None = None,
        description: DeviceDescription | None = None,
    ) -> None:
        """Send a device's state, behind the figures that agree with it."""
        self.publish_figures()
        self.put((STATE,), state_message(device_id, state, reason, link, description))

    def publish_figures(self) -> None:
        """Send the figures of all devices."""
        if self.figures is not None:
            self.put((STATE,), figures_message(self.figures()))

    def end(self, device_id: str) -> None:
        """Send that a device was deleted."""
        self.publish_figures()
        self.put((STATE,), end_message(device_id))

    def subscribers(self, device_id: str) -> int:
        """Return the number of clients of a device, at all gateways."""
        return self._clients[device_id]

    def on_clients(self, listener: Callable[[str, int], None]) -> None:
        """Call with a device and its number of clients whenever that changes."""
        self._listeners.append(listener)

    def client_counts(self) -> dict[str, int]:
        """Return the number of clients of each device that had any."""
        return dict(self._clients)

    def set_clients(self, counts: Mapping[str, int]) -> None:
        """Take how many clients each device has now, at all gateways together."""
        before, self._clients = self._clients, Counter(counts)
        for device_id in before.keys() | self._clients.keys():
            if before[device_id] != self._clients[device_id]:
                for listener in self._listeners:
                    listener(device_id, self._clients[device_id])

    def relay(self, kind: MessageKind, header: Sequence[Any], end: int, data: bytes) -> None:
        """Pass a message of the shared memory on; called in the event loop."""
        if kind is MessageKind.BATCH:
            device_id, frames = header[0], header[1]
            if header[4]:
                self._renew(device_id, header[4][-1])
            if self.pixels[device_id]:
                self._outbox.collect((PIXELS, device_id), data, frames)
            self._outbox.collect((BATCH, device_id), without_pixels(data, header, end), frames)
        elif kind is MessageKind.POSES:
            self._outbox.put((POSES, header[0]), data)

    def _renew(self, device_id: str, rows: Sequence[Any]) -> None:
        """Say at once how long beams stay enabled: their batch waits for others."""
        now_s = time.monotonic()
        if now_s - self._renewed_s.get(device_id, 0.0) >= RENEWAL_S:
            self._renewed_s[device_id] = now_s
            self._outbox.put((HOLDS,), renewal_message(device_id, rows))

    def prepared(self, device_id: str, message: bytes) -> None:
        """Say what the batches behind this are processed with."""
        self._outbox.collect((BATCH, device_id), message, 0)
        if self.pixels[device_id]:
            self._outbox.collect((PIXELS, device_id), message, 0)


class RelayTap(CalibrationListener):
    """Stands for a tap at another machine: tells it what the batches are processed with."""

    def __init__(
        self, relay: Relay, device_id: str, gateway: str, number: int, *, wants_pixels: bool
    ) -> None:
        self.wants_pixels = wants_pixels
        self._relay = relay
        self._device_id = device_id
        self._gateway = gateway
        self._number = number
        self._newest: bytes | None = None

    def prepare(self, found: ActiveCalibration) -> None:
        """Tell it before the first batch that is processed with this."""
        radiometric = found.radiometric
        stored = (
            found.calibration_id,
            found.table_id,
            None if radiometric is None else radiometric.radiometric_id,
        )
        self._newest = prepared_message(
            self._device_id, self._gateway, self._number, stored, found.bad_pixels
        )
        self.repeat()

    def repeat(self) -> None:
        """Tell it again; called in the event loop."""
        if self._newest is not None:
            self._relay.prepared(self._device_id, self._newest)


class RelayingPipeline(RemotePipeline):
    """RemotePipeline of a station's host, whose clients are at other machines."""

    streams: Relay

    def _take_split(self, kind: MessageKind, header: Sequence[Any], end: int, data: bytes) -> None:
        self.streams.relay(kind, header, end, data)
        super()._take_split(kind, header, end, data)
        if kind is MessageKind.FIGURES:
            self.streams.publish_figures()

    def far_figures(self) -> StationFigures:
        """Return the figures as other machines have them: starts of each process come apart."""
        epoch = self._restarts * GENERATIONS
        devices = {
            device_id: replace(one, generation=one.generation + epoch)
            for device_id, one in self._figures.devices.items()
        }
        return replace(self._figures, devices=devices)

    def far_session(self, device_id: str, generation: int) -> RemoteDevice | None:
        """Return a running device by the number of its start that other machines have."""
        device = self._devices.get(device_id)
        known = device is not None and device.generation + self._restarts * GENERATIONS
        return device if device is not None and known == generation else None

    def tell_again(self) -> None:
        """Say again what another machine may have missed; called in the event loop."""
        self.streams.publish_figures()
        self.holds.listen(self.streams.put_hold)()
        self.notify("resynchronise")

    @property
    def restarts(self) -> int:
        """How often the process that owns the devices was lost."""
        return self._restarts

    @property
    def process_id(self) -> int:
        """The process that owns the devices."""
        return self._station.process_id

    @property
    def messages_missed(self) -> int:
        """Messages that were overwritten before they were read."""
        return self._messages_missed
