"""Tap of a running device that sums up its observations interval by interval."""

from dataclasses import dataclass, field
from threading import Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.point_batch import PointBatch, PointFlag
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch

Array = NDArray[np.float64]


_TOGETHER: Final = 64
"""Batches that are added up together."""


@dataclass
class IntervalSums:
    """Sums over an interval with one calibration and table.

    Args:
        calibration_id: of the calibration.
        table_id: of the table.
        begin_ns: device time of the first frame.
        end_ns: of the last.
        points: with a position.
        checked: of them those with four or more sensors.
        residual_sum_of_squares: sum of theirs, in variances.
        inconsistent: points whose readings contradict one another.
        reference_count: points of the reference marker.
        reference_sum: of its positions, less the first of them [mm].
        reference_square: of the squares of the same.
        reference_first: its first position.
    """

    calibration_id: str
    table_id: str | None
    begin_ns: int
    end_ns: int
    points: int = 0
    checked: int = 0
    residual_sum_of_squares: float = 0.0
    inconsistent: int = 0
    reference_count: int = 0
    reference_sum: Array = field(default_factory=lambda: np.zeros(3))
    reference_square: float = 0.0
    reference_first: Array | None = None

    @property
    def seconds(self) -> float:
        """Time that was watched, on the device's clock."""
        return (self.end_ns - self.begin_ns) * 1e-9

    @property
    def residual_sigma(self) -> float | None:
        """Root of the mean square residual; None where no point had one."""
        return float(np.sqrt(self.residual_sum_of_squares / self.checked)) if self.checked else None

    @property
    def reference_mm(self) -> Array | None:
        """Mean position of the reference marker."""
        if self.reference_first is None:
            return None
        mean: Array = self.reference_first + self.reference_sum / self.reference_count
        return mean

    @property
    def reference_scatter_mm(self) -> float | None:
        """RMS distance of the reference marker from its mean."""
        if self.reference_first is None:
            return None
        mean = self.reference_sum / self.reference_count
        spread = self.reference_square / self.reference_count - float(mean @ mean)
        return float(np.sqrt(max(0.0, spread)))


class IntervalStatisticsTap:
    """Adds up batches; ``take`` hands over what there is and begins anew.

    Args:
        reference: the strobed marker that never moves; None: there is none.
    """

    wants_pixels: Final = False

    def __init__(self, reference: int | None) -> None:
        self.reference = reference
        self._lock = Lock()
        self._done: list[IntervalSums] = []
        self._now: IntervalSums | None = None
        self._pending: list[tuple[PointBatch, NDArray[np.bool_]]] = []
        """Points that are not added up yet, and which are of the reference marker."""

    def prepare(self, found: ActiveCalibration) -> None:
        """Do nothing: the batches say what they were made with."""

    def take(self) -> list[IntervalSums]:
        """Return the sums since the last call, one for each calibration and table."""
        with self._lock:
            self._add_pending()
            done, now = self._done, self._now
            self._done, self._now = [], None
        return done if now is None else [*done, now]

    def put_back(self, sums: list[IntervalSums]) -> None:
        """Return sums that could not be stored to the next call of ``take``."""
        with self._lock:
            self._done = [*sums, *self._done]

    @property
    def seconds(self) -> float:
        """Observed time with the now active calibration [s]."""
        now = self._now
        return 0.0 if now is None else now.seconds

    def offer(self, batch: FrameBatch) -> None:
        """Add a batch; called where frames are processed."""
        if batch.calibration_id is None:
            return
        begin = batch.frames[0].exposure_device_ns
        with self._lock:
            now = self._now
            made_with = (batch.calibration_id, batch.table_id)
            if now is None or (now.calibration_id, now.table_id) != made_with:
                if now is not None:
                    self._add_pending()
                    self._done.append(now)
                now = self._now = IntervalSums(*made_with, begin, begin)
            now.end_ns = batch.frames[-1].exposure_device_ns
            if len(batch.points):
                marker = np.array([frame.marker == self.reference for frame in batch.frames])
                self._pending.append((batch.points, marker[batch.owner]))
            if len(self._pending) >= _TOGETHER:
                self._add_pending()

    def _add_pending(self) -> None:
        """Add up what waits: many small batches cost as much as one large one."""
        pending, self._pending = self._pending, []
        if pending and self._now is not None:
            points = PointBatch.concatenate([points for points, _ in pending])
            self._add(self._now, points, np.concatenate([reference for _, reference in pending]))

    def _add(self, sums: IntervalSums, points: PointBatch, reference: NDArray[np.bool_]) -> None:
        found = np.isfinite(points.position_mm[:, 0])
        found &= (points.flags & int(PointFlag.AMBIGUOUS)) == 0
        sums.points += int(found.sum())
        residual = points.residual_sigma()
        checked = found & np.isfinite(residual)
        sums.checked += int(checked.sum())
        sums.residual_sum_of_squares += float((residual[checked] ** 2).sum())
        sums.inconsistent += int((points.flags & int(PointFlag.INCONSISTENT) != 0).sum())
        if self.reference is None:
            return
        places = points.position_mm[found & reference]
        if len(places):
            if sums.reference_first is None:
                sums.reference_first = places[0].copy()
            away = places - sums.reference_first
            sums.reference_count += len(places)
            sums.reference_sum += away.sum(axis=0)
            sums.reference_square += float((away**2).sum())
