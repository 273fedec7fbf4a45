"""Poses relative to a reference tool or in a registered frame."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import Transform
from service.api.tools.tip_limit import exceeded_reason

Array = NDArray[np.float64]

POSE_STATUSES: Final = (
    PoseStatus.OK,
    PoseStatus.LOW_RELIABILITY,
    PoseStatus.OUT_OF_VOLUME,
    PoseStatus.HIGH_ERROR,
)
"""The statuses that have a pose; what is made of two is worth no more than the worse."""


def pose_in_frame(
    pose: ToolPose,
    reference: ToolPose | None = None,
    frame_from: Transform | None = None,
    tip_covariance_mm2: Array | None = None,
    max_tip_sd_mm: float | None = None,
) -> ToolPose:
    """Return a pose in another frame than the tracker's.

    Errors of the two poses are taken to be independent. What they have in common, that of the
    calibration, mostly drops out of the one relative to the other: the covariance is an upper
    bound where the tools are near one another.

    Args:
        pose: of a tool, in the tracker's frame.
        reference: pose of the reference tool at the same instant; None: the tracker.
        frame_from: transform to the frame from the reference's; None: that itself.
        tip_covariance_mm2: of the tip in the tool's coordinates, shape (3, 3) [mm^2]; None: exact.
        max_tip_sd_mm: standard deviation of the tip in the frame above which the pose is
            HIGH_ERROR [mm]; None: only the two poses are judged, each by itself.

    Returns:
        The pose, without velocities, which are the tracker's, and without covariances unless both
        poses have them; of one that is not known, or whose reference is not, the reason.
    """
    moved = replace(pose, velocity_mm_s=None, angular_velocity_rad_s=None)
    known = pose.covariance is not None
    if reference is not None:
        known &= reference.covariance is not None
    if pose.rotation is None or pose.translation_mm is None:
        return moved
    if reference is not None and reference.rotation is None:
        why = reference.reason or "it has no pose"
        return _nothing(pose, reference.status, f'its reference "{reference.tool}": {why}')
    own = pose.transform()
    found = own
    if reference is not None:
        found = reference.transform().inverse() @ found
    if frame_from is not None:
        found = frame_from @ found
    status, reason = pose.status, pose.reason
    if reference is not None and status_rank(reference.status) > status_rank(status):
        status, reason = reference.status, f'its reference "{reference.tool}": {reference.reason}'
    tip = spread = None
    if pose.tip_mm is not None:
        tip = own.rotation.T @ (pose.tip_mm - own.translation_mm)
        if known:
            spread = found.point_covariance(tip, tip_covariance_mm2)
    if spread is not None and max_tip_sd_mm is not None and status in POSE_STATUSES[:-1]:
        above = exceeded_reason(float(np.sqrt(np.trace(spread))), max_tip_sd_mm)
        if above is not None:
            status, reason = PoseStatus.HIGH_ERROR, above
    return replace(
        moved,
        status=status,
        reason=reason,
        rotation=found.rotation,
        translation_mm=found.translation_mm,
        covariance=found.covariance if known else None,
        tip_mm=None if tip is None else found.apply(tip),
        tip_covariance_mm2=spread,
    )


def status_rank(status: PoseStatus) -> int:
    """Return how little a status is worth: of two poses the worse counts."""
    return POSE_STATUSES.index(status) if status in POSE_STATUSES else len(POSE_STATUSES)


def _nothing(pose: ToolPose, status: PoseStatus, reason: str) -> ToolPose:
    return ToolPose(
        pose.tool,
        PoseStatus.MISSING if status is PoseStatus.OK else status,
        reason,
        pose.exposure_ns,
        pose.sequence,
        residual_sigma=pose.residual_sigma,
        markers_used=pose.markers_used,
        readings_used=pose.readings_used,
    )
