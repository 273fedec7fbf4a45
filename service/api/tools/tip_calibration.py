"""Pivot and spin calibration from the live poses of a tool."""

import math
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from compute.errors import TooFewPoses
from compute.pose.rigid_body import ToolPose
from service.api.tools.pose_taps import PoseTap
from service.api.tools.schema import NewToolCalibration
from service.pipeline.interface import Pipeline
from service.pipeline.tap_collection import collect

if TYPE_CHECKING:
    from compute.pose.tool_calibration.pivot import PivotResult
    from compute.pose.tool_calibration.spin import SpinResult

MAX_COLLECTED: Final = 100_000


def calibrate_tip(
    live: Pipeline,
    device_id: str,
    tool_id: str,
    reference: str | None,
    kind: Literal["pivot", "spin"],
    asked: NewToolCalibration,
) -> dict[str, Any]:
    """Collect poses for as long as was asked, and return the members of ToolCalibration.

    Raises:
        DeviceNotRunning: the device does not run, or ends meanwhile.
        CalibrationSwitched: another calibration came into force meanwhile.
        TooFewPoses: the tool was hardly seen.
        TooLittleRotation, HighError, NoConvergence: as the calibration says.
    """
    session = live.session(device_id)
    tap = PoseTap(tool_id, reference if asked.relative else None, MAX_COLLECTED)
    collect(live, session, tap, asked.duration_s, tap.ended)
    tap.check_single(device_id, "poses were collected; do it again")
    chosen = subsample(tap.poses, asked.poses)
    if not chosen:
        seen = ", ".join(f"{status}: {count}" for status, count in tap.statuses.items())
        raise TooFewPoses(
            f'no pose of tool "{tool_id}" was OK in {asked.duration_s:g} s '
            f"({seen or 'no frame came'}{f'; {tap.reason}' if tap.reason else ''})",
            poses=0,
        )
    calibration_id, table_id = tap.active_ids or (None, None)
    return _found(kind, chosen, asked.min_swing_deg) | {
        "calibration_id": calibration_id,
        "table_id": table_id,
    }


def subsample(poses: list[ToolPose], max_poses: int) -> list[ToolPose]:
    """Return at most ``max_poses`` poses, evenly spaced."""
    if len(poses) <= max_poses:
        return poses
    return [
        poses[index] for index in np.linspace(0, len(poses) - 1, max_poses).astype(int).tolist()
    ]


def _found(
    kind: Literal["pivot", "spin"], poses: list[ToolPose], min_swing_deg: float | None
) -> dict[str, Any]:
    limits: dict[str, Any] = {}
    if min_swing_deg is not None:
        limits["min_swing_rad"] = math.radians(min_swing_deg)
    rotations = np.array([pose.rotation for pose in poses])
    translations = np.array([pose.translation_mm for pose in poses])
    known = all(pose.covariance is not None for pose in poses)
    covariances = np.array([pose.covariance for pose in poses]) if known else None
    found: PivotResult | SpinResult
    vectors: dict[str, Any] = dict.fromkeys(("tip_mm", "tip_covariance_mm2", "axis", "point_mm"))
    if kind == "pivot":
        from compute.pose.tool_calibration.pivot import PivotSettings, pivot_calibration

        found = pivot_calibration(rotations, translations, covariances, PivotSettings(**limits))
        swing = found.orientations.swing_rad
        vectors["tip_mm"] = found.tip_mm.tolist()
        vectors["tip_covariance_mm2"] = found.tip_covariance_mm2.tolist()
    else:
        from compute.pose.tool_calibration.spin import SpinSettings, spin_calibration

        settings = SpinSettings(**limits)
        found = spin_calibration(rotations, translations, covariances, settings=settings)
        swing = found.orientations.swing_rad[1:]  # the least of them is the axis's own
        vectors["axis"] = found.direction.tolist()
        vectors["point_mm"] = found.point_mm.tolist()
    return vectors | {
        "poses": len(poses) - len(found.outlying),
        "outliers": len(found.outlying),
        "rms_mm": found.rms_mm,
        "residual_sigma": found.residual_sigma,
        "smallest_rotation_deg": float(np.degrees(np.min(swing))),
    }
