"""Taps: consumers of a running device's batches beside the streams."""

import logging
import time
from collections.abc import Iterator
from threading import Event
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from compute.measurement.flag_policy import STANDARD_POLICY
from compute.reconstruction.point_batch import PointFlag
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.problems.errors import CalibrationSwitched, NoActiveCalibration

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

UNFIT_POINT: Final = PointFlag.AMBIGUOUS | PointFlag.NO_COVARIANCE
"""Flags of points that are no sample of where a marker is."""


class Tap(Protocol):
    """Takes the batches of a running device beside the streams."""

    @property
    def wants_pixels(self) -> bool:
        """Whether it needs the frames' pixels; without them ``lines`` may be empty."""
        ...

    def prepare(self, found: ActiveCalibration) -> None:
        """Learn the calibration that becomes active next; called in a thread that may wait."""
        ...

    def offer(self, batch: FrameBatch) -> None:
        """Copy the wanted data of a batch; called where frames are processed, never waits long."""
        ...


def log_failed_tap(device_id: str, tap: Tap, error: Exception) -> None:
    """Log that a tap failed, and has no more of a device's frames."""
    _log.error(
        "device %s: %s failed and has no more of its frames",
        device_id,
        type(tap).__name__,
        exc_info=error,
        extra={"device": device_id},
    )


class PeakTap:
    """Collects frames of a strobed marker, or frames in which a single marker is lit.

    Of a strobed frame the brightest peak of each sensor is the marker; of others a sensor counts
    when it saw one peak and no other.
    """

    wants_pixels: Final = False

    def __init__(self, after_sequence: int, frames: int, marker: int | None) -> None:
        """Take ``frames`` frames of ``marker`` that were exposed after that sequence number."""
        self._after = after_sequence
        self._frames = frames
        self._marker = marker
        self._rows: list[tuple[Array, Array]] = []
        self.ended = Event()
        """Set when all frames are there."""

    def prepare(self, found: ActiveCalibration) -> None:
        """Do nothing: readings do not depend on it."""

    def offer(self, batch: FrameBatch) -> None:
        """Copy the wanted data of a batch; called where frames are processed, never waits long."""
        sensors = len(batch.sensor_names)
        readings = []
        for index, frame in enumerate(batch.frames):
            if frame.marker != self._marker or frame.sequence <= self._after:
                continue
            lines = slice(index * sensors, (index + 1) * sensors)
            readings.append(clear_readings(batch, lines, strobed=frame.marker is not None))
        self._rows += readings[: self._frames - len(self._rows)]
        if len(self._rows) >= self._frames:
            self.ended.set()

    def readings(self, sensors: int) -> tuple[Array, Array]:
        """Return positions and their sigmas [px], shape (frames, sensors), NaN: not seen."""
        position, sigma = np.array(list(self._rows)).reshape(-1, 2, sensors).swapaxes(0, 1)
        return position, sigma


def clear_readings(
    batch: FrameBatch, lines: slice | NDArray[np.intp], *, strobed: bool
) -> tuple[Array, Array]:
    """Return the readings of the marker in some lines of a batch, and their sigmas [px].

    Args:
        batch: frames with their peaks.
        lines: those of one frame, or the numbers of any.
        strobed: whether the brightest peak is the marker; else a line must have one peak only.

    Returns:
        Both of shape (S,); NaN where there is no clear peak.
    """
    peaks = batch.peaks
    position = peaks.position_px[lines].astype(np.float64)
    visible = np.isfinite(position)
    brightest = np.where(visible, peaks.amplitude[lines], -1.0).argmax(axis=1)
    row = np.arange(len(position))
    clear = (peaks.flags[lines][row, brightest] & int(STANDARD_POLICY.unclear_flags)) == 0
    clear &= visible.any(axis=1) if strobed else visible.sum(axis=1) == 1
    value = np.where(clear, position[row, brightest], np.nan)
    sigma = np.where(clear, peaks.sigma_px[lines][row, brightest], np.nan)
    return value, sigma.astype(np.float64)


class SingleCalibrationTap:
    """Base of taps that need one calibration and table throughout; ends when they change."""

    wants_pixels: Final = False

    def __init__(self) -> None:
        self.ended = Event()
        """Set when there is enough, or another calibration or table became active."""
        self.switched = False
        """Whether another calibration or table became active meanwhile."""
        self.active_ids: tuple[str | None, str | None] | None = None
        """Calibration and table of the first batch; None: none came."""

    def prepare(self, found: ActiveCalibration) -> None:
        """Do nothing: the batches name their calibration and table."""

    def _goes_on(self, batch: FrameBatch) -> bool:
        """Return whether all that came was made with the same, and more is wanted."""
        batch_ids = (batch.calibration_id, batch.table_id)
        if self.active_ids is None:
            self.active_ids = batch_ids
        if batch_ids != self.active_ids:
            self.switched = True
            self.ended.set()
        return not self.ended.is_set()

    def check_single(self, device_id: str, during: str) -> None:
        """Raise CalibrationSwitched where the calibration or table changed.

        Args:
            device_id: of the device.
            during: what was done then and what to do now: ``it was measured; try again``.
        """
        if self.switched:
            raise CalibrationSwitched(
                f'another calibration or table of device "{device_id}" was activated while '
                f"{during}",
                device_id=device_id,
            )

    def calibration_used(self, device_id: str, during: str) -> tuple[str, str | None]:
        """Return the calibration and table of all batches; for arguments see ``check_single``.

        Raises:
            CalibrationSwitched: the calibration or table changed.
            NoActiveCalibration: there was none, or no batch came.
        """
        self.check_single(device_id, during)
        calibration_id, table_id = self.active_ids or (None, None)
        if calibration_id is None:
            raise NoActiveCalibration(
                f'device "{device_id}" has no active calibration, and so no points; activate one',
                device_id=device_id,
            )
        return calibration_id, table_id


_POLL_INTERVAL_S: Final = 0.1


def poll(ended: Event, seconds: float) -> Iterator[None]:
    """Yield several times a second, for some seconds, or until an event is set."""
    end = time.monotonic() + seconds
    while (remaining_s := end - time.monotonic()) > 0 and not ended.wait(
        min(_POLL_INTERVAL_S, remaining_s)
    ):
        yield
