"""FusionAssembler: frames of all bars in, fused frames out, in order and within a bounded wait.

The first bar that is there gives the times; its frames wait until the others have an exposure
behind the one next to theirs, or for ``max_wait_s``. Whatever comes later than that is used for
later frames only. It has no clock and no threads: times are given.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.fusion.alignment import AlignedReadings
from compute.fusion.bar_history import BarExposure, BarHistory
from compute.fusion.clock_errors import PeakRates
from compute.signal.peaks import PeakBatch
from hardware.line_frame import FrameFlag, LineFrame
from service.pipeline.fusion.fused_frame import PEAK_ARRAYS, FusedFrame

Array = NDArray[np.float64]

MAX_PENDING: Final = 512
"""Frames of the reference that wait at most; older ones go out as they are."""


@dataclass(frozen=True, eq=False)
class BarFrame:
    """One frame of a bar.

    Args:
        frame: as its driver made it; its scans are not needed.
        peaks: of its S scans.
        time_ns: middle of the exposure on the clock that all bars are referred to [ns].
        sigma_ns: standard deviation of that time, the same error in all frames [ns].
        arrived_s: when it came, on a clock that does not go back [s].
    """

    frame: LineFrame
    peaks: PeakBatch
    time_ns: int
    sigma_ns: float
    arrived_s: float


class _Bar:
    """One bar: its exposures, and whether it is there."""

    def __init__(self, sensors: int) -> None:
        self.sensors = sensors
        self.history: BarHistory[BarFrame] = BarHistory()
        self.sigma_ns = 0.0
        self.away = True


class FusionAssembler:
    """Puts the frames of several bars together.

    Args:
        device_id: the fused device.
        sensors: number of sensors of each bar, in order.
        max_wait_s: how long a frame waits for readings of the other bars [s].
        extra_sigma_s: standard deviation of any two bars' clocks beyond what frames state [s].
    """

    def __init__(
        self, device_id: str, sensors: Sequence[int], max_wait_s: float, extra_sigma_s: float
    ) -> None:
        self._device_id = device_id
        self._bars = [_Bar(count) for count in sensors]
        self._max_wait_s = max_wait_s
        self._extra_sigma_s = extra_sigma_s
        self._pending: deque[BarFrame] = deque()
        self._sequence = 0
        self._last_ns: int | None = None
        self._reference: int | None = None

    @property
    def reference(self) -> int | None:
        """Index of the bar that gives the times; None: none is there."""
        return next((index for index, bar in enumerate(self._bars) if not bar.away), None)

    def set_away(self, bar: int, *, away: bool) -> None:
        """Leave a bar out, or take it in again; its earlier exposures do not count."""
        one = self._bars[bar]
        if one.away != away:
            one.away = away
            one.history.clear()
            if bar == self._reference:
                # They have been waiting for others; the next reference's come from now on.
                self._pending.clear()

    def add(self, bar: int, frame: BarFrame) -> None:
        """Take a frame of a bar; those of one that is away are dropped."""
        one = self._bars[bar]
        if one.away:
            return
        one.sigma_ns = frame.sigma_ns
        self._change_reference()
        is_later = self._last_ns is None or frame.time_ns > self._last_ns
        if bar == self._reference and is_later:
            self._pending.append(frame)
        position = frame.peaks.position_px
        variance = np.square(frame.peaks.sigma_px.astype(np.float64))
        usable = np.isfinite(position + variance)
        one.history.add(
            frame.frame.marker,
            BarExposure(
                frame.time_ns,
                np.where(usable, position, np.nan),
                np.where(usable, variance, 1.0),
                frame,
            ),
        )

    def _change_reference(self) -> None:
        reference = self.reference
        if reference != self._reference:
            self._pending.clear()
            self._reference = reference

    def take(self, now_s: float) -> list[FusedFrame]:
        """Return the frames that are complete, or have waited for long enough."""
        self._change_reference()
        frames = []
        while self._pending and (
            len(self._pending) > MAX_PENDING
            or self._is_complete(self._pending[0])
            or now_s >= self._pending[0].arrived_s + self._max_wait_s
        ):
            frames.append(self._fuse(self._pending.popleft()))
        return frames

    def due_s(self) -> float | None:
        """When the oldest frame has waited for long enough; None: none waits."""
        return self._pending[0].arrived_s + self._max_wait_s if self._pending else None

    def _is_complete(self, reference: BarFrame) -> bool:
        return all(
            bar.away or bar.history.is_ready(reference.time_ns, reference.frame.marker)
            for index, bar in enumerate(self._bars)
            if index != self._reference
        )

    def _fuse(self, reference: BarFrame) -> FusedFrame:
        parts: list[tuple[PeakBatch, PeakRates]] = []
        flags = reference.frame.flags
        clock_of_sensor: list[int] = []
        clock, sigmas = 0, []
        for index, bar in enumerate(self._bars):
            if index == self._reference:
                parts.append((reference.peaks, _zeros(reference.peaks.position_px.shape)))
                clock_of_sensor += [-1] * bar.sensors
                continue
            sigma_ns = float(np.hypot(reference.sigma_ns, bar.sigma_ns))
            sigmas.append(float(np.hypot(1e-9 * sigma_ns, self._extra_sigma_s)))
            found = bar.history.at(reference.time_ns, reference.frame.marker)
            if bar.away or found is None:
                parts.append((PeakBatch.empty(bar.sensors, 1), _zeros((bar.sensors, 1))))
                clock_of_sensor += [-1] * bar.sensors
            else:
                exposure, aligned = found
                flags |= exposure.origin.frame.flags & FrameFlag.SATURATED
                parts.append(_moved(exposure.origin.peaks, aligned))
                clock_of_sensor += [clock] * bar.sensors
            clock += 1
        self._last_ns = reference.time_ns
        peaks, rates = _stack(parts)
        self._sequence += 1
        return FusedFrame(
            device=self._device_id,
            sequence=self._sequence - 1,
            exposure_device_ns=reference.time_ns,
            exposure_host_ns=reference.time_ns,
            marker=reference.frame.marker,
            lines=np.empty((len(peaks), 0), np.uint16),
            flags=flags,
            peaks=peaks,
            rates=rates,
            bar_of_sensor=np.array(clock_of_sensor, dtype=np.intp),
            clock_sigma_s=np.array(sigmas),
            reference=self._reference or 0,
        )


def _zeros(shape: tuple[int, ...]) -> PeakRates:
    return PeakRates(*(np.zeros(shape) for _ in range(3)))


def _moved(peaks: PeakBatch, aligned: AlignedReadings) -> tuple[PeakBatch, PeakRates]:
    """Return peaks at the positions that they have at another time, in ascending order."""
    moved = PeakBatch.empty(*peaks.position_px.shape)
    order = aligned.position_px.argsort(axis=1, kind="stable")
    rows = np.arange(len(order))[:, None]
    moved.count[:] = np.isfinite(aligned.position_px).sum(axis=1)
    for name in PEAK_ARRAYS:
        getattr(moved, name)[:] = getattr(peaks, name)[rows, order]
    moved.position_px[:] = aligned.position_px[rows, order]
    moved.sigma_px[:] = np.sqrt(aligned.variance_px2[rows, order])
    # Of neighbours that were fitted together; each has moved by itself since.
    moved.covariance_px2[:] = 0.0
    lost = ~np.isfinite(moved.position_px)
    for name in PEAK_ARRAYS:
        values = getattr(moved, name)
        values[lost] = 0 if name in {"flags", "covariance_px2"} else np.nan
    rates = (aligned.rate_px_s, aligned.rate_variance_px2_s2, aligned.covariance_px2_s)
    return moved, PeakRates(*(np.where(lost, 0.0, rate[rows, order]) for rate in rates))


def _stack(parts: Sequence[tuple[PeakBatch, PeakRates]]) -> tuple[PeakBatch, PeakRates]:
    """Return the peaks and rates of all bars, one behind the other."""
    room = max(peaks.position_px.shape[1] for peaks, _ in parts)
    sensors = sum(len(peaks) for peaks, _ in parts)
    stacked, rates = PeakBatch.empty(sensors, room), _zeros((sensors, room))
    first = 0
    for peaks, its in parts:
        last, columns = first + len(peaks), peaks.position_px.shape[1]
        stacked.count[first:last] = peaks.count
        for name in PEAK_ARRAYS:
            getattr(stacked, name)[first:last, :columns] = getattr(peaks, name)
        for all_rates, one in zip(vars(rates).values(), vars(its).values(), strict=True):
            all_rates[first:last, :columns] = one
        first = last
    return stacked, rates
