"""RemoteDevice: a running device of a station, with the taps that its batches are given to."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from threading import RLock
from typing import Any, Protocol

from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.detection_stage import Method, SearchModel, peak_method
from service.pipeline.device_status import DeviceStatus
from service.pipeline.taps import Tap, log_failed_tap
from service.problems.errors import DeviceNotRunning, NotReady
from service.station.bus_messages import BatchMessage, DeviceFigures


class StationCalls(Protocol):
    """What a device asks of its station, by whatever way it is reached."""

    def call(self, method: str, *args: Any, **members: Any) -> Any:
        """Call a method of the station; returns when all that it caused has come by the bus."""
        ...

    def notify(self, method: str, *args: Any) -> None:
        """Call a method of the station whose answer nobody needs."""
        ...

    def next_tap(self) -> int:
        """Return a number for a tap."""
        ...

    def calibration(self, device_id: str) -> ActiveCalibration:
        """Return the calibration that a device was last told to use."""
        ...

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status."""
        ...


class CalibrationListener:
    """A tap that only learns what batches are processed with: they are not read for it."""

    wants_pixels: bool = False

    def prepare(self, found: ActiveCalibration) -> None:
        """Learn the calibration that becomes active next."""
        raise NotImplementedError

    def offer(self, batch: object) -> None:
        """Do nothing."""


@dataclass(eq=False)
class _AttachedTap:
    tap: Tap
    prepared: bool = False


class RemoteDevice:
    """One device of a station, from its start to its stop; see ``RunningDevice``."""

    def __init__(self, station: StationCalls, device_id: str, figures: DeviceFigures) -> None:
        assert figures.description is not None
        self._station = station
        self.device_id = device_id
        self.generation = figures.generation
        self.description = figures.description
        self._figures = figures
        self._prepared_with: ActiveCalibration | None = None
        self._missed = 0
        self._newest: int | None = None
        self._interrupted = self._resumes = False
        self._lock = RLock()
        """Held while a batch is offered: a detached tap has all that it was being given."""
        self.taps: dict[int, _AttachedTap] = {}
        """By number."""

    def update(self, figures: DeviceFigures) -> None:
        """Take newer figures of this start."""
        self._figures = figures

    def end(self) -> None:
        """Note that nothing more comes: it was started again, or its station is lost."""
        self._figures = replace(self._figures, running=False, connected=False, drained=True)

    @property
    def running(self) -> bool:
        """Whether frames still come, or will when the device is connected again."""
        return self._figures.running

    @property
    def connected(self) -> bool:
        """Whether it runs and its device is there."""
        return self._figures.connected

    @property
    def drained(self) -> bool:
        """Whether all frames are processed, and offered to taps, and no more will come."""
        return self._figures.drained

    @property
    def active_calibration(self) -> ActiveCalibration:
        """What its newest batch was processed with."""
        active = self._prepared_with or self._station.calibration(self.device_id)
        return replace(active, bad_pixels=self._figures.status.bad_pixels)

    @property
    def method(self) -> Method | None:
        """How its peaks are found; None: nothing reads its scans."""
        return peak_method(self.description)

    @property
    def search_model(self) -> SearchModel:
        """What its peaks are found with; waits for the station."""
        model: SearchModel = self._station.call("search_model", self.device_id)
        return model

    @property
    def last_sequence(self) -> int:
        """Sequence number of the newest frame; -1 before the first; waits for the station."""
        number: int = self._station.call("last_sequence", self.device_id)
        return number

    @property
    def frames_dropped(self) -> int:
        """Frames that taps lack: nobody took them in time, here or at the station."""
        return self._figures.status.frames_dropped_compute + self._missed

    @property
    def wants_pixels(self) -> bool:
        """Whether any of its taps wants pixels."""
        return any(one.tap.wants_pixels for one in tuple(self.taps.values()))

    def peak_settings(self) -> dict[str, Any]:
        """Return the method of peak detection and its errors as a JSON object."""
        return self._figures.peak_settings

    def status(self) -> DeviceStatus:
        """Return its status."""
        return self._station.status(self.device_id)

    def attach(self, tap: Tap, *, sampled: bool = False) -> None:
        """Give a tap all batches from now on; ``sampled``: some seconds of a minute are enough."""
        number = self._station.next_tap()
        with self._lock:
            self.taps[number] = _AttachedTap(tap)
        try:
            self._station.call(
                "attach",
                self.device_id,
                self.generation,
                number,
                sampled=sampled,
                pixels=tap.wants_pixels,
            )
        except (DeviceNotRunning, NotReady):
            # It has ended meanwhile: whoever waits for its batches sees that.
            return

    def detach(self, tap: Tap) -> None:
        """Give a tap no more batches; what it was being given, it has when this returns."""
        with self._lock:
            numbers = [number for number, one in self.taps.items() if one.tap is tap]
            for number in numbers:
                del self.taps[number]
            self._resume()
            if not self.taps:
                self._interrupted, self._newest = False, None
        for number in numbers:
            self._station.notify("detach", number)

    def prepare(self, number: int, active: ActiveCalibration) -> bool:
        """Tell a tap what its next batches are processed with; return whether it is of here."""
        with self._lock:
            one = self.taps.get(number)
            if one is None:
                return False
            self._prepared_with = active
            self._guarded(number, one, partial(one.tap.prepare, active))
            one.prepared = True
            self._resume()
            return True

    def has_tap(self, number: int) -> bool:
        """Whether a tap is of here."""
        return number in self.taps

    def _resume(self) -> None:
        """Offer batches again, once all taps know what they are processed with."""
        if self._interrupted and all(one.prepared for one in self.taps.values()):
            self._interrupted, self._resumes = False, True

    def interrupt(self) -> None:
        """Offer no more until taps know again what batches are processed with: some were missed."""
        with self._lock:
            self._interrupted = bool(self.taps)
            for one in self.taps.values():
                one.prepared = False

    def switch(self) -> None:
        """Note that batches come another way from now on: none twice, and a gap is counted."""
        with self._lock:
            self._resumes = bool(self.taps)

    def offer(self, message: BatchMessage) -> None:
        """Offer a batch to the taps that know what it was processed with."""
        with self._lock:
            if self._interrupted or not self.taps:
                return
            if self._resumes and self._newest is not None:
                if message.last_sequence <= self._newest:
                    return  # it came another way
                self._missed += max(0, message.first_sequence - self._newest - 1)
            self._newest, self._resumes = message.last_sequence, False
            if all(isinstance(one.tap, CalibrationListener) for one in self.taps.values()):
                return
            batch = message.read()
            for number, one in tuple(self.taps.items()):
                if one.prepared:
                    self._guarded(number, one, partial(one.tap.offer, batch))

    def _guarded(self, number: int, one: _AttachedTap, act: Callable[[], object]) -> None:
        """Let a tap do something; one that fails has no more, and the device goes on."""
        try:
            act()
        except Exception as error:  # noqa: BLE001 - of the tap, not of the device
            self.taps.pop(number, None)
            self._station.notify("detach", number)
            log_failed_tap(self.device_id, one.tap, error)
