"""MarkerTap: collects positions of strobed markers, relative to a reference tool."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import ToolPose
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.taps import UNFIT_POINT, SingleCalibrationTap

Array = NDArray[np.float64]

MAX_OBSERVATIONS: Final = 50_000
"""Of all markers; those after them are not taken."""


@dataclass(frozen=True, eq=False)
class MarkerObservation:
    """One exposure of a marker.

    Args:
        time_ns: on the device's clock [ns].
        position_mm: in the tracker's frame, shape (3,) [mm].
        covariance_mm2: shape (3, 3) [mm^2].
        reference: pose of the reference tool in that exposure; None: none was asked for.
    """

    time_ns: int
    position_mm: Array
    covariance_mm2: Array
    reference: ToolPose | None

    def relative(self) -> tuple[Array, Array]:
        """Return position and covariance in the frame of the reference, else of the tracker."""
        if self.reference is None:
            return self.position_mm, self.covariance_mm2
        back = self.reference.transform().inverse()
        return (
            back.apply(self.position_mm),
            back.point_covariance(self.position_mm, self.covariance_mm2),
        )


class MarkerTap(SingleCalibrationTap):
    """Collects exposures of strobed markers while one calibration and table are active.

    Args:
        markers: the strobed markers.
        reference: the tool that they are wanted relative to; exposures without its pose count for
            nothing. None: the tracker.
    """

    def __init__(self, markers: tuple[int, ...], reference: str | None) -> None:
        super().__init__()
        self.observations: dict[int, list[MarkerObservation]] = {marker: [] for marker in markers}
        self.without_reference = 0
        """Exposures of the markers in which the reference had no pose to use."""
        self.reason: str | None = None
        """Why the newest of those poses was not one to use."""
        self._reference = reference
        self._left = MAX_OBSERVATIONS

    def offer(self, batch: FrameBatch) -> None:
        """Collect from a batch; called where frames are processed."""
        if not self._goes_on(batch):
            return
        good = np.isfinite(batch.points.position_mm[:, 0])
        good &= (batch.points.flags & int(UNFIT_POINT)) == 0
        # Of two points in one exposure of one marker nobody knows which it is.
        alone = np.bincount(batch.owner, minlength=len(batch.frames)) == 1
        for row in np.flatnonzero(good & alone[batch.owner]).tolist():
            frame = int(batch.owner[row])
            exposure = batch.frames[frame]
            wanted = self.observations.get(-1 if exposure.marker is None else exposure.marker)
            if wanted is None or self._left <= 0:
                continue
            reference = None
            if self._reference is not None:
                reference = self._pose(batch, frame)
                if reference is None:
                    self.without_reference += 1
                    continue
            wanted.append(
                MarkerObservation(
                    exposure.exposure_device_ns,
                    batch.points.position_mm[row].astype(np.float64),
                    batch.points.covariance_mm2[row].astype(np.float64),
                    reference,
                )
            )
            self._left -= 1

    def _pose(self, batch: FrameBatch, frame: int) -> ToolPose | None:
        poses = () if batch.motion is None else batch.motion.poses_of(frame)
        pose = next((one for one in poses if one.tool == self._reference), None)
        if pose is not None and pose.valid:
            return pose
        self.reason = "the device does not track it yet" if pose is None else pose.reason
        return None
