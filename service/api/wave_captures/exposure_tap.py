"""ExposureTap: hands strobed exposures of a target's markers to the thread that takes poses."""

from collections import deque
from collections.abc import Sequence
from threading import Event
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.self_calibration.strobed_poses import StrobedReadings
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.taps import clear_readings

Array = NDArray[np.float64]

MAX_WAITING: Final = 10_000
"""Batches that wait at most; more are dropped, which the poses count as exposures not lit."""


class ExposureTap:
    """Takes the exposures of a target's strobed markers from the compute thread.

    Args:
        after_sequence: frames after this sequence number count.
        markers: numbers of the target's strobed markers.
        sensors: number of sensors.
    """

    wants_pixels: Final = False

    def __init__(self, after_sequence: int, markers: Sequence[int], sensors: int) -> None:
        self._after = after_sequence
        self._markers = frozenset(markers)
        self._sensors = sensors
        self._begin_ns: int | None = None
        self._waiting: deque[tuple[list[tuple[int, int]], Array, Array, NDArray[np.bool_]]] = deque(
            maxlen=MAX_WAITING
        )
        self.seen = np.zeros((3, sensors), dtype=np.intp)
        """Exposures of each sensor with a clear peak, with an unclear one, without, shape (3, S);
        written by ``take``."""
        self.ended = Event()
        """Set by whoever wants no more."""

    def prepare(self, found: ActiveCalibration) -> None:
        """Do nothing: readings do not depend on it."""

    def offer(self, batch: FrameBatch) -> None:
        """Copy the readings of a batch; called where frames are processed, never waits."""
        wanted = [
            index
            for index, frame in enumerate(batch.frames)
            if frame.marker in self._markers and frame.sequence > self._after
        ]
        if not wanted:
            return
        exposed = [
            (batch.frames[index].exposure_device_ns, batch.frames[index].marker or 0)
            for index in wanted
        ]
        lines = (np.array(wanted)[:, None] * self._sensors + np.arange(self._sensors)).ravel()
        position, sigma = clear_readings(batch, lines, strobed=True)
        visible = np.asarray(np.isfinite(batch.peaks.position_px[lines]).any(axis=1))
        self._waiting.append((exposed, position, sigma, visible))

    def take(self) -> StrobedReadings:
        """Return the exposures that came since the last call, in the order of time."""
        batches = [self._waiting.popleft() for _ in range(len(self._waiting))]
        exposed = [one for batch in batches for one in batch[0]]
        position, sigma, visible = (
            np.concatenate([batch[part] for batch in batches]) if batches else np.empty(0)
            for part in (1, 2, 3)
        )
        shape = (len(exposed), self._sensors)
        clear = np.isfinite(position).reshape(shape)
        visible = visible.astype(np.bool_).reshape(shape)
        self.seen += [clear.sum(axis=0), (visible & ~clear).sum(axis=0), (~visible).sum(axis=0)]
        if exposed and self._begin_ns is None:
            self._begin_ns = exposed[0][0]
        return StrobedReadings(
            np.array([1e-9 * (ns - (self._begin_ns or 0)) for ns, _ in exposed]),
            np.array([marker for _, marker in exposed], dtype=np.intp),
            position.reshape(shape),
            sigma.reshape(shape),
        )
