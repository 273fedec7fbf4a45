"""Pivot and spin calibration from the live poses of a tool."""

from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.errors import TooFewPoses
from compute.pose.rigid_body import ToolPose
from service.api.tools.pose_taps import PoseTap
from service.api.tools.schema import NewToolCalibration
from service.pipeline.pipeline_manager import PipelineManager
from service.pipeline.taps import collect
from service.problems.errors import CalibrationSwitched

Array = NDArray[np.float64]

MAX_COLLECTED: Final = 100_000


def calibrate_tip(
    live: PipelineManager,
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
    collect(live, session, tap, asked.seconds, tap.ended)
    if tap.switched:
        raise CalibrationSwitched(
            f'another calibration or table of device "{device_id}" was activated while poses were '
            "collected; do it again",
            device=device_id,
        )
    chosen = subsample(tap.poses, asked.poses)
    if not chosen:
        seen = ", ".join(f"{status}: {count}" for status, count in tap.statuses.items())
        raise TooFewPoses(
            f'no pose of tool "{tool_id}" was OK in {asked.seconds:g} s '
            f"({seen or 'no frame came'}{f'; {tap.reason}' if tap.reason else ''})",
            poses=0,
        )
    calibration_id, table_id = tap.active_ids or (None, None)
    return _found(kind, chosen) | {"calibration": calibration_id, "table": table_id}


def subsample(poses: list[ToolPose], max_poses: int) -> list[ToolPose]:
    """Return at most ``max_poses`` poses, evenly spaced."""
    if len(poses) <= max_poses:
        return poses
    return [
        poses[index] for index in np.linspace(0, len(poses) - 1, max_poses).astype(int).tolist()
    ]


def _found(kind: Literal["pivot", "spin"], poses: list[ToolPose]) -> dict[str, Any]:
    rotations = np.array([pose.rotation for pose in poses])
    translations = np.array([pose.translation_mm for pose in poses])
    known = all(pose.covariance is not None for pose in poses)
    covariances = np.array([pose.covariance for pose in poses]) if known else None
    if kind == "pivot":
        from compute.pose.tool_calibration.pivot import pivot_calibration

        pivot = pivot_calibration(rotations, translations, covariances)
        return _members(
            len(poses),
            pivot.outlying,
            pivot.rms_mm,
            pivot.residual_sigma,
            pivot.orientations.swing_rad,
            tip_mm=pivot.tip_mm,
            tip_covariance_mm2=pivot.tip_covariance_mm2,
        )
    from compute.pose.tool_calibration.spin import spin_calibration

    spin = spin_calibration(rotations, translations, covariances)
    return _members(
        len(poses),
        spin.outlying,
        spin.rms_mm,
        spin.residual_sigma,
        spin.orientations.swing_rad[1:],  # the least of them is the axis's own
        axis=spin.direction,
        point_mm=spin.point_mm,
    )


def _members(
    poses: int,
    outlying: tuple[int, ...],
    rms_mm: float,
    residual_sigma: float | None,
    swing_rad: Array,
    **vectors: Array,
) -> dict[str, Any]:
    none: dict[str, Any] = dict.fromkeys(("tip_mm", "tip_covariance_mm2", "axis", "point_mm"))
    return none | {
        "poses": poses - len(outlying),
        "outliers": len(outlying),
        "rms_mm": rms_mm,
        "residual_sigma": residual_sigma,
        "smallest_rotation_deg": float(np.degrees(np.min(swing_rad))),
        **{name: vector.tolist() for name, vector in vectors.items()},
    }
