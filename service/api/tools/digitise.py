"""Digitises the position of a tool's stationary tip from its live poses."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.pose.tool_calibration.digitising import (
    StationaryCapture,
    StationaryPoint,
    StationarySettings,
)
from service.api.tools.frame_conversion import pose_in_frame
from service.api.tools.point_schema import NewPoint
from service.api.tools.pose_query import Frame
from service.api.tools.pose_taps import TipTap
from service.api.tools.tip_limit import TipLimit
from service.pipeline.interface import Pipeline
from service.pipeline.tap_collection import collect
from service.problems.errors import CalibrationSwitched, NoActiveCalibration, NoObservation

Array = NDArray[np.float64]

_GAP_FRAMES: Final = 5.0
_MIN_GAP_S: Final = 0.1
_CHECK_INTERVAL_NS: Final = 50_000_000
"""How often it is looked whether the tip is still: a thousand times a second takes a core."""


@dataclass(frozen=True, eq=False)
class Pointer:
    """A tool whose tip is a point's.

    Args:
        tool: its id.
        device: its device's.
        limit: what its poses are worth, and the covariance of its tip.
    """

    tool: str
    device: str
    limit: TipLimit


def digitise_point(
    live: Pipeline, pointer: Pointer, frame: Frame, asked: NewPoint
) -> dict[str, Any]:
    """Wait until the tip is held still; return the members of MeasuredPoint that were found.

    Raises:
        DeviceNotRunning: the device does not run, or ends meanwhile.
        NoActiveCalibration: there are no poses without one.
        CalibrationSwitched: another came into force meanwhile, or the frame is of another.
        NoObservation: the tip was not seen, or not well enough, in all of that time.
        NotStationary, TooFewPoses: it was not still for long enough; why, of the last interval.
    """
    session = live.session(pointer.device)
    rate = session.description.frame_rate_hz or 0.0
    gap_s = max(_MIN_GAP_S, _GAP_FRAMES / rate) if rate > 0.0 else _MIN_GAP_S
    waiting = _Digitiser(pointer, frame, asked, gap_s)
    collect(live, session, waiting.tap, asked.timeout_s, waiting.tap.ended, waiting.poll)
    calibration, table = waiting.tap.active_ids or ("", None)
    if calibration is None:
        raise NoActiveCalibration(
            f'device "{pointer.device}" has no active calibration, and so no poses; activate one',
            device_id=pointer.device,
        )
    found = waiting.end()
    return {
        "position_mm": found.position_mm.tolist(),
        "covariance_mm2": found.covariance_mm2.tolist(),
        "sigma_mm": found.sigma_mm,
        "drift_mm": found.drift_mm,
        "frames": found.poses,
        "first_ns": found.first_ns,
        "last_ns": found.last_ns,
        "calibration_id": calibration,
        "table_id": table,
    }


class _Digitiser:
    """Puts the poses that came into the capture, until it has a point."""

    def __init__(self, pointer: Pointer, frame: Frame, asked: NewPoint, gap_s: float) -> None:
        self.tap = TipTap(pointer.tool, frame.reference)
        self._pointer = pointer
        self._frame = frame
        self._asked = asked
        self._capture = StationaryCapture(
            StationarySettings(
                seconds=asked.duration_s,
                max_sigma_mm=asked.max_sigma_mm,
                max_drift_mm=asked.max_drift_mm,
                max_gap_s=gap_s,
            )
        )
        self._found: StationaryPoint | None = None
        self._looked_ns: int | None = None
        self._good = 0
        self._statuses: dict[PoseStatus, int] = {}
        self._reason: str | None = None

    def poll(self) -> bool:
        """Take what came; return whether there is a point.

        Raises:
            CalibrationSwitched: the frame does not belong to the active calibration.
        """
        of = self._frame.provenance
        if of is not None and self.tap.active_ids is not None:
            why = of.invalid_reason(*self.tap.active_ids)
            if why is not None:
                raise CalibrationSwitched(why, frame_id=self._frame.name)
        for pose, reference in self.tap.drained():
            if self._found is None:
                self._put(pose, reference)
        return self._found is not None

    def end(self) -> StationaryPoint:
        """Return the point; raises as ``measured`` says where there is none."""
        self.poll()
        if self._found is None and self._good:
            self._found = self._capture.take()
        if self._found is not None:
            return self._found
        tool = self._pointer.tool
        self.tap.check_single(self._pointer.device, "the point was measured; do it again")
        told = f'the tip of tool "{tool}" was not held still within {self._asked.timeout_s:g} s'
        if not self._good:
            seen = ", ".join(f"{status}: {count}" for status, count in self._statuses.items())
            raise NoObservation(
                f"{told}: no pose of it was OK ({seen or 'no frame came'}"
                f"{f'; {self._reason}' if self._reason else ''})",
                frames=0,
            )
        error = self._capture.error
        raise type(error)(f"{told}: {error.detail}{self._others()}", **error.context)

    def _others(self) -> str:
        """Return a message with the number of frames without a usable pose."""
        without = sum(count for status, count in self._statuses.items() if status != "OK")
        if not without:
            return ""
        return f"; {without} frames had no pose to use, the last: {self._reason}"

    def _shared(self, moved: ToolPose) -> Array:
        """Return the covariance common to all positions: of the tip and of the registration."""
        assert moved.rotation is not None
        assert moved.tip_mm is not None
        shared = np.zeros((3, 3))
        own, frame = self._pointer.limit.tip_covariance_mm2, self._frame.frame_from
        if own is not None:
            shared += moved.rotation @ own @ moved.rotation.T
        if frame is not None:
            shared += frame.point_covariance(frame.inverse().apply(moved.tip_mm))
        return shared

    def _put(self, pose: ToolPose, reference: ToolPose | None) -> None:
        moved = pose_in_frame(
            pose,
            reference,
            self._frame.frame_from,
            self._pointer.limit.tip_covariance_mm2,
            self._pointer.limit.max_sd_mm,
        )
        self._statuses[moved.status] = self._statuses.get(moved.status, 0) + 1
        if not moved.valid or moved.tip_mm is None:
            self._reason = moved.reason
            return
        self._good += 1
        shared = self._shared(moved)
        self._capture.add_sample(moved.exposure_ns, moved.tip_mm, moved.tip_covariance_mm2, shared)
        since = None if self._looked_ns is None else moved.exposure_ns - self._looked_ns
        if since is None or not 0 <= since < _CHECK_INTERVAL_NS:
            self._looked_ns = moved.exposure_ns
            self._found = self._capture.take()
