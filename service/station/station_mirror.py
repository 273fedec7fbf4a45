"""StationMirror: what a gateway knows of a station, from the messages of its bus.

The messages are the same whether they come through shared memory or over the network; who reads
them gives each to ``take``. Statuses, figures and poses are answered from what came last, and never
wait.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count
from typing import Any, Final, Protocol

from hardware.driver import DeviceDescription
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.device_session import StreamPublisher, ToolCounts
from service.pipeline.device_status import DeviceState, DeviceStatus
from service.pipeline.frame_batch import LatestPoses
from service.pipeline.interface import RunningDevice
from service.pipeline.stage_latency import Stage
from service.pipeline.tap_collection import not_running
from service.station.bus_messages import (
    BatchMessage,
    DeviceFigures,
    HoldTokens,
    MessageKind,
    StationFigures,
    read_description,
    read_figures,
    read_hold,
    read_poses,
    split_message,
)
from service.station.remote_device import RemoteDevice
from service.station.remote_holds import RemoteHolds

ENDED: Final = ("stopped", "failed", "ended")
"""States of a device of which no frames come."""


class ClientStreams(StreamPublisher, Protocol):
    """StreamPublisher that takes batches as bytes, and tells how many clients there are."""

    def publish_message(self, message: BatchMessage) -> None:
        """Send a batch of frames, which is read when a client wants it."""
        ...

    def on_clients(self, listener: Callable[[str, int], None]) -> None:
        """Call with a device and its number of clients whenever that changes."""
        ...

    def client_counts(self) -> dict[str, int]:
        """Return the number of clients of each device that had any."""
        ...


class StationMirror(ABC):
    """Takes a station's messages, and answers what they say.

    Args:
        streams: takes the results for the clients.
        poses: takes the newest poses of all tools.
    """

    def __init__(self, streams: ClientStreams, poses: LatestPoses) -> None:
        self.streams = streams
        self.poses = poses
        """The newest poses of all tools."""
        self.holds = RemoteHolds(
            lambda hold_id: bool(self.call("acknowledge", hold_id)),
            lambda reference_id: self.notify("set_up", reference_id),
            streams.publish_hold,
        )
        """Whether beams are held."""
        self._tokens: HoldTokens = self.holds
        """Takes the deadlines of holds, which are those of the station's machine."""
        self._figures = StationFigures({}, ready=False)
        self._devices: dict[str, RemoteDevice] = {}
        self._away: dict[str, DeviceFigures] = {}
        """Devices of a lost station that are not back yet."""
        self._unoffered: list[tuple[RemoteDevice, BatchMessage]] = []
        """Batches that clients were told of, and taps were not yet."""
        self._tap_numbers = count(1)
        self._messages_missed = 0

    @abstractmethod
    def call(self, method: str, *args: Any, **members: Any) -> Any:
        """Call a method of the station; returns when all that it caused has come by the bus."""

    @abstractmethod
    def notify(self, method: str, *args: Any) -> None:
        """Call a method of the station whose answer nobody needs."""

    @abstractmethod
    def calibration(self, device_id: str) -> ActiveCalibration:
        """Return the calibration that a device was last told to use."""

    @abstractmethod
    def _comes_back(self, device_id: str) -> bool:
        """Whether a device of a lost station will run again by itself."""

    @abstractmethod
    def _take_calibration(self, *header: Any) -> None:
        """Take what batches are processed with from now on."""

    @property
    def ready(self) -> bool:
        """Whether the station processes frames."""
        return self._figures.ready

    @property
    def busy_s(self) -> float:
        """Time that the station has spent on its current batch or job [s]."""
        return self._figures.busy_s

    def next_tap(self) -> int:
        """Return a number for a tap."""
        return next(self._tap_numbers)

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status; "stopped" for one never started. Never waits."""
        found = self._figures.devices.get(device_id)
        gone = device_id in self._away and not self._comes_back(device_id)
        status = DeviceStatus("stopped") if found is None or gone else found.status
        return replace(status, subscribers=self.streams.subscribers(device_id))

    def statuses(self) -> dict[str, DeviceStatus]:
        """Return the status of every device that was started, or tried to. Never waits."""
        return {device_id: self.status(device_id) for device_id in self._figures.devices}

    def latencies(self) -> dict[str, tuple[tuple[int, ...], float]]:
        """Return the latencies of batches by class, and their sum [s], by device. Never waits."""
        return {name: one.latency for name, one in self._ran().items()}

    def stage_latencies(self) -> dict[str, tuple[int, dict[Stage, float]]]:
        """Return frames that were timed, and their time in each stage [s], by device."""
        return {name: one.stages for name, one in self._ran().items()}

    def pose_counts(self) -> dict[str, dict[str, ToolCounts]]:
        """Return pose counts by device and tool, of devices that were started. Never waits."""
        return {
            name: {
                tool: ToolCounts(Counter(frames), newest_ns)
                for tool, (frames, newest_ns) in one.tools.items()
            }
            for name, one in self._ran().items()
        }

    def describe(self, device_id: str) -> DeviceDescription | None:
        """Return the driver's description of a device; None: it was never started. Never waits."""
        found = self._figures.devices.get(device_id)
        return None if found is None else found.description

    def session(self, device_id: str) -> RunningDevice:
        """Return a running device; raises DeviceNotRunning. Never waits."""
        device = self._devices.get(device_id)
        if device is None or not device.running:
            raise not_running(device_id, self.status(device_id))
        return device

    def _ran(self) -> dict[str, DeviceFigures]:
        return {
            name: one for name, one in self._figures.devices.items() if one.description is not None
        }

    def _take(self, data: bytes) -> None:
        """Take a message; called in the event loop of the clients."""
        kind, header, end = split_message(data)
        self._take_split(kind, header, end, data)

    def _take_split(self, kind: MessageKind, header: Sequence[Any], end: int, data: bytes) -> None:
        if kind is MessageKind.BATCH:
            self._take_batch(BatchMessage(data, header, end, self._tokens))
            return
        if kind is MessageKind.POSES:
            self.poses.put(read_poses(header))
            return
        # All others say something of what came before them.
        self._offer()
        if kind is MessageKind.HOLD:
            device_id, row, last = header
            self.holds.change(device_id, read_hold(row, self._tokens), last=last)
        elif kind is MessageKind.FIGURES:
            self._take_figures(read_figures(header[0]))
        elif kind is MessageKind.STATE:
            device_id, state, reason, link, described = header
            if state in ENDED or state == "disconnected":
                self.poses.remove(device_id)
            description = read_description(described)
            self.streams.publish_status(device_id, state, reason, link, description)
        elif kind is MessageKind.CALIBRATION:
            self._take_calibration(*header)
        else:
            self.streams.end(*header)

    def _take_batch(self, message: BatchMessage) -> None:
        device_id = message.device_id
        if message.holds:
            self.holds.take(device_id, message.holds[-1])
        self.streams.publish_message(message)
        device = self._devices.get(device_id)
        if device is not None and device.taps:
            self._unoffered.append((device, message))
        else:
            message.drop_pixels()

    def _offer(self) -> None:
        """Offer the taps what the clients were told of: they can wait for those."""
        unoffered, self._unoffered = self._unoffered, []
        for device, message in unoffered:
            device.offer(message)
            message.drop_pixels()

    def _take_figures(self, figures: StationFigures) -> None:
        away = {name: one for name, one in self._away.items() if name not in figures.devices}
        # Not "stopped" while it is their turn to be started again.
        self._away = {name: one for name, one in away.items() if self._comes_back(name)}
        for device_id in away.keys() - self._away.keys():
            self.streams.publish_status(device_id, "stopped")
        if self._away:
            figures = replace(figures, devices=self._away | figures.devices)
        self._figures = figures
        for device_id, one in figures.devices.items():
            known = self._devices.get(device_id)
            if known is not None and known.generation == one.generation:
                known.update(one)
                continue
            if known is not None:
                self._devices.pop(device_id).end()
            if one.running:
                self._devices[device_id] = RemoteDevice(self, device_id, one)
        for device_id in self._devices.keys() - figures.devices.keys():
            self._devices.pop(device_id).end()

    def _interrupt(self) -> None:
        """Offer no batches until it is known again what they are processed with."""
        self._offer()
        for device in self._devices.values():
            device.interrupt()

    def _tell_lost(self, state: DeviceState, reason: str) -> None:
        """Tell that the station's devices are away, in that state, or have ended with it."""
        self.holds.fail(reason)
        figures, away = {}, {}
        for device_id, one in self._figures.devices.items():
            device = self._devices.pop(device_id, None)
            if device is not None:
                device.end()
            if self._comes_back(device_id):
                status = replace(one.status, state=state, reason=reason)
                away[device_id] = DeviceFigures(status, description=one.description)
            elif one.status.state in ENDED:
                status = one.status
            else:
                status = replace(one.status, state="stopped", reason=None)  # as it was told to
            figures[device_id] = away.get(device_id) or replace(
                one, status=status, generation=0, running=False, connected=False
            )
            if status is not one.status:
                self.poses.remove(device_id)
                self.streams.publish_status(device_id, status.state, status.reason)
        self._figures = StationFigures(figures, ready=False)
        self._away = away
