"""FusionDriver: a device of all sensors of several bars, which are devices beside it."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from threading import Event
from time import monotonic
from typing import Final

import numpy as np

from compute.errors import InvalidParameter
from compute.signal.peaks import PeakBatch
from hardware.driver import DeviceDescription
from hardware.errors import DeviceNotConnected
from hardware.line_frame import LineFrame
from hardware.link import ReportingDriver
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.fusion.assembler import BarFrame, FusionAssembler
from service.pipeline.fusion.fused_frame import PEAK_ARRAYS
from service.pipeline.fusion.settings import FusedBar, FusionSettings
from service.pipeline.interface import KnownDevices, RunningDevice

LOOK_S: Final = 0.1
"""How often it is looked whether bars are there."""
SILENT_S: Final = 0.5
"""A bar of which nothing came for that long is left out, or for twenty of its frames."""
MAX_WAITING: Final = 4096
"""Frames of bars that wait to be taken; older ones are dropped."""
UNKNOWN_SIGMA_NS: Final = 1e6
"""Of a clock that does not know yet how well it is known."""


class BarTap:
    """Takes the peaks of a bar's frames; calls what collects them."""

    wants_pixels: Final = False

    def __init__(self, take: Callable[[LineFrame, PeakBatch], None]) -> None:
        self._take = take

    def prepare(self, found: ActiveCalibration) -> None:
        """Do nothing: peaks do not depend on it."""

    def offer(self, batch: FrameBatch) -> None:
        """Copy the peaks of a batch, frame by frame."""
        sensors = len(batch.sensor_names)
        for index, frame in enumerate(batch.frames):
            scans = slice(index * sensors, (index + 1) * sensors)
            arrays = {name: getattr(batch.peaks, name)[scans].copy() for name in PEAK_ARRAYS}
            peaks = PeakBatch(count=batch.peaks.count[scans].copy(), **arrays)
            # Its scans are not needed any more, and may be large.
            self._take(replace(frame, lines=_NO_PIXELS), peaks)


_Arrived = tuple[int, RunningDevice, LineFrame, PeakBatch, float]
"""Number of the bar, its session, a frame with its peaks, and when it came [s]."""
_NO_PIXELS: Final = np.empty((0, 0), np.uint16)


class FusionDriver(ReportingDriver["_Session"]):
    """Fuses the frames of bars that are devices of the same pipeline.

    It goes on with the bars that are there; its link says which are not, and takes them in again by
    itself. Without any it is disconnected.

    Args:
        name: the device's name.
        bars: the bars; the first one that is there gives the times.
        settings: how they are put together.

    Raises:
        InvalidParameter: there are fewer than two bars, one is named twice, or their sensors have
            different numbers of pixels.
    """

    lossless = False

    def __init__(self, name: str, bars: Sequence[FusedBar], settings: FusionSettings) -> None:
        super().__init__()
        names = [bar.device_id for bar in bars]
        if len(bars) < 2 or len(set(names)) < len(names) or name in names:
            raise InvalidParameter(
                f"bars is {', '.join(names)}; it must name two devices or more, each once, and not "
                f'"{name}" itself',
                bars=names,
            )
        pixels = {sensor.pixels for bar in bars for sensor in bar.sensors}
        if len(pixels) > 1:
            raise InvalidParameter(
                f"the bars' sensors have {', '.join(map(str, sorted(pixels)))} pixels; all must "
                "have as many",
                bars=names,
            )
        self._name = name
        self._bars = tuple(bars)
        self._settings = settings
        self._devices: KnownDevices | None = None
        self._described: DeviceDescription | None = None

    def bind(self, devices: KnownDevices) -> None:
        """Take the devices among which the bars are; called before ``open``."""
        self._devices = devices

    @property
    def description(self) -> DeviceDescription:
        """The device's properties; rates and noise are those of the first bar that is there.

        Before ``open`` only the sensors are known.
        """
        return self._described or self._describe(None)

    def _describe(self, bar: DeviceDescription | None) -> DeviceDescription:
        sensors = tuple(
            replace(sensor, name=f"{one.device_id}.{sensor.name}")
            for one in self._bars
            for sensor in one.sensors
        )
        return DeviceDescription(
            name=self._name,
            sensors=sensors,
            frame_rate_hz=0.0 if bar is None else bar.frame_rate_hz,
            bits=16 if bar is None else bar.bits,
            electrons_per_count=1.0 if bar is None else bar.electrons_per_count,
            read_noise_electrons=0.0 if bar is None else bar.read_noise_electrons,
            offset_counts=0.0 if bar is None else bar.offset_counts,
            markers=0 if bar is None else bar.markers,
            readout="bar-peaks",
            peaks="fit" if bar is None else bar.peaks,
        )

    def open(self) -> None:
        """Attach to the bars that are there.

        Raises:
            DeviceNotConnected: none of them is there; it may be tried again.
        """
        self.close()
        session = _Session(self._name, self._bars, self._settings, self._find)
        self._session = session
        first = session.look()
        if first is None:
            reason = session.reason()
            session.close()
            raise DeviceNotConnected(f"none of the bars is there: {reason}")
        self._described = self._describe(first)
        self._report.reset()
        self._tell(session)

    def _find(self, device_id: str) -> RunningDevice | None:
        return None if self._devices is None else self._devices.known_session(device_id)

    def frames(self) -> Iterator[LineFrame]:
        """Yield fused frames until ``close`` is called.

        Raises:
            RuntimeError: the driver was never opened.
        """
        session = self._opened()
        return session.frames(lambda: self._tell(session))

    def _tell(self, session: "_Session") -> None:
        """Report which bars are there."""
        reason = session.reason()
        self._report.set_state("connected" if session.any_there else "disconnected", reason)


class _Session:
    """Taps of the bars, and what they have brought."""

    def __init__(
        self,
        name: str,
        bars: tuple[FusedBar, ...],
        settings: FusionSettings,
        find: Callable[[str], RunningDevice | None],
    ) -> None:
        self._bars = bars
        self._find = find
        self._closed = Event()
        self._arrived: deque[_Arrived] = deque(maxlen=MAX_WAITING)
        self._doorbell = Event()
        self._taps: list[tuple[RunningDevice, BarTap] | None] = [None] * len(bars)
        self._heard_s = [0.0] * len(bars)
        self._away: list[str | None] = ["it has not been looked for"] * len(bars)
        self._assembler = FusionAssembler(
            name,
            [len(bar.sensors) for bar in bars],
            1e-3 * settings.max_wait_ms,
            1e-6 * settings.clock_uncertainty_us,
        )

    @property
    def any_there(self) -> bool:
        """Whether any bar is there."""
        return None in self._away

    def reason(self) -> str | None:
        """Which bars are away, and why; None: none is."""
        away = [
            f'"{bar.device_id}" is away: {why}'
            for bar, why in zip(self._bars, self._away, strict=True)
            if why is not None
        ]
        return "; ".join(away) or None

    def close(self) -> None:
        """End the frames, and leave the bars."""
        self._closed.set()
        self._doorbell.set()
        for index in range(len(self._bars)):
            self._leave(index)

    def _leave(self, index: int) -> None:
        attached, self._taps[index] = self._taps[index], None
        if attached is not None:
            device, tap = attached
            device.detach(tap)

    def look(self, now_s: float | None = None) -> DeviceDescription | None:
        """Attach to bars that have come, leave those that have gone.

        Args:
            now_s: time.monotonic() [s]; None: it does not matter how long they are silent.

        Returns:
            The description of the first bar that is there; None: none is.
        """
        first = None
        for index, bar in enumerate(self._bars):
            device = self._find(bar.device_id)
            why = _why_away(bar, device)
            attached = self._taps[index]
            if attached is not None and attached[0] is not device:
                self._leave(index)
                attached = None
            if why is None and device is not None:
                if attached is None and not self._closed.is_set():
                    self._attach(index, device, now_s)
                elif now_s is not None and now_s > self._heard_s[index] + _silent_s(device):
                    why = "no frames come from it"
                first = first or (device.description if why is None else None)
            self._away[index] = why
            self._assembler.set_away(index, away=why is not None)
        return first

    def _attach(self, index: int, device: RunningDevice, now_s: float | None) -> None:
        def take(frame: LineFrame, peaks: PeakBatch) -> None:
            self._arrived.append((index, device, frame, peaks, monotonic()))
            self._doorbell.set()

        tap = BarTap(take)
        self._taps[index] = device, tap
        self._heard_s[index] = monotonic() if now_s is None else now_s
        device.attach(tap)

    def frames(self, changed: Callable[[], None]) -> Iterator[LineFrame]:
        """Yield fused frames; ``changed`` is called after each look for bars."""
        looked_s = -LOOK_S
        while not self._closed.is_set():
            due_s = self._assembler.due_s()
            wait_s = LOOK_S if due_s is None else min(LOOK_S, max(0.0, due_s - monotonic()))
            self._doorbell.wait(wait_s)
            self._doorbell.clear()
            # Before the look: what came while this thread was busy has been heard.
            while self._arrived:
                self._take(self._arrived.popleft())
            now_s = monotonic()
            if now_s - looked_s >= LOOK_S:
                looked_s = now_s
                self.look(now_s)
                changed()
            yield from self._assembler.take(now_s)

    def _take(self, arrived: _Arrived) -> None:
        index, device, frame, peaks, at_s = arrived
        attached = self._taps[index]
        if attached is None or attached[0] is not device:
            return
        self._heard_s[index] = at_s
        if self._away[index] is not None:
            # It was silent, and is back.
            self._away[index] = None
            self._assembler.set_away(index, away=False)
        sigma_ns = frame.host_sigma_ns
        self._assembler.add(
            index,
            BarFrame(
                frame,
                peaks,
                frame.exposure_host_ns,
                sigma_ns if np.isfinite(sigma_ns) else UNKNOWN_SIGMA_NS,
                at_s,
            ),
        )


def _silent_s(device: RunningDevice) -> float:
    rate_hz = device.description.frame_rate_hz
    return max(SILENT_S, 20.0 / rate_hz if rate_hz > 0.0 else 0.0)


def _why_away(bar: FusedBar, device: RunningDevice | None) -> str | None:
    """Return why a bar is not there; None: it is."""
    if device is None:
        return "it was not started"
    if not device.connected:
        status = device.status()
        return f"it is {status.state}" + (f" ({status.reason})" if status.reason else "")
    found = tuple((sensor.name, sensor.pixels) for sensor in device.description.sensors)
    stored = tuple((sensor.name, sensor.pixels) for sensor in bar.sensors)
    if found != stored:
        names = ", ".join(name for name, _ in found)
        return f"it has other sensors now, {names}; send the fused device's source anew"
    return None
