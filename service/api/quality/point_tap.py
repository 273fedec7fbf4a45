"""PointTap: collects a running device's points for some seconds, with marker and time."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.quality.accuracy import MarkerTrack
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.taps import UNFIT_POINT, SingleCalibrationTap

Array = NDArray[np.float64]

MAX_POINTS: Final = 200_000
"""Of one check; those after them are not taken."""


@dataclass
class _Rows:
    time_ns: list[NDArray[np.int64]] = field(default_factory=list)
    position: list[Array] = field(default_factory=list)
    covariance: list[Array] = field(default_factory=list)

    def track(self) -> MarkerTrack:
        if not self.time_ns:
            return MarkerTrack(np.empty(0), np.empty((0, 3)), np.empty((0, 3, 3)))
        time_ns = np.concatenate(self.time_ns)
        return MarkerTrack(
            (time_ns - time_ns[0]) * 1e-9,
            np.concatenate(self.position),
            np.concatenate(self.covariance),
        )


class PointTap(SingleCalibrationTap):
    """Collects points by marker while one calibration and table are active.

    Points of markers that are lit together have no name: frames with as many of them as asked
    for are taken, and their points are in the order in which they were found.

    Args:
        markers: strobed markers; None: frames in which all are lit.
        together: how many are in view then.
    """

    def __init__(self, markers: tuple[int, ...] | None, together: int) -> None:
        super().__init__()
        self.left_out = 0
        self._markers = markers
        self._rows = [_Rows() for _ in range(together)]
        self._taken = 0

    def offer(self, batch: FrameBatch) -> None:
        """Collect from a batch; called where frames are processed."""
        if not self._goes_on(batch) or self._taken >= MAX_POINTS:
            return
        marker = np.array(
            [-1 if frame.marker is None else frame.marker for frame in batch.frames], dtype=np.int64
        )
        time_ns = np.array([frame.exposure_device_ns for frame in batch.frames], dtype=np.int64)
        good = np.isfinite(batch.points.position_mm[:, 0])
        good &= (batch.points.flags & int(UNFIT_POINT)) == 0
        if self._markers is None:
            self._together(batch, marker, time_ns, good)
        else:
            of = marker[batch.owner]
            for rows, wanted in zip(self._rows, self._markers, strict=True):
                self._take(rows, batch, (of == wanted) & good, time_ns)
                self.left_out += int(((of == wanted) & ~good).sum())

    def tracks(self) -> list[MarkerTrack]:
        """Return one track for each marker; times are from the first point of all."""
        starts = [rows.time_ns[0][0] for rows in self._rows if rows.time_ns]
        found = []
        for rows in self._rows:
            track = rows.track()
            if rows.time_ns:
                shift = float(rows.time_ns[0][0] - min(starts)) * 1e-9
                track = MarkerTrack(track.time_s + shift, track.position_mm, track.covariance_mm2)
            found.append(track)
        return found

    def _together(
        self,
        batch: FrameBatch,
        marker: NDArray[np.int64],
        time_ns: NDArray[np.int64],
        good: NDArray[np.bool_],
    ) -> None:
        count = np.bincount(batch.owner[good], minlength=len(batch.frames))
        whole = (marker == -1) & (count == len(self._rows))
        self.left_out += int(((marker == -1) & ~whole).sum())
        chosen = np.flatnonzero(good & whole[batch.owner])
        for place, rows in enumerate(self._rows):
            mask = np.zeros(len(good), dtype=np.bool_)
            mask[chosen[place :: len(self._rows)]] = True
            self._take(rows, batch, mask, time_ns)

    def _take(
        self, rows: _Rows, batch: FrameBatch, mask: NDArray[np.bool_], time_ns: NDArray[np.int64]
    ) -> None:
        if not mask.any():
            return
        rows.time_ns.append(time_ns[batch.owner[mask]])
        rows.position.append(batch.points.position_mm[mask])
        rows.covariance.append(batch.points.covariance_mm2[mask])
        self._taken += int(mask.sum())


def check_strobed(device_id: str, numbers: Sequence[int], strobes: int) -> None:
    """Raise InvalidParameter when a marker's number exceeds the device's strobed markers."""
    unknown = next((number for number in numbers if number >= strobes), None)
    if unknown is not None:
        known = f"0 to {strobes - 1}" if strobes else "none: they are lit together"
        raise InvalidParameter(
            f'device "{device_id}" has no strobed marker {unknown}; it has {known}',
            marker=unknown,
        )
