"""A tool's pose as the JSON members that REST and the stream have in common."""

from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_quaternion
from compute.pose.tool_pose import ToolPose

Array = NDArray[np.float64]


def pose_message(pose: ToolPose) -> dict[str, Any]:
    """Return a pose with the members of ToolPose, and its rotation as a quaternion, too."""
    sigma = pose.residual_sigma
    return {
        "tool": pose.tool,
        "status": pose.status.value,
        "reason": pose.reason,
        "translation_mm": _values(pose.translation_mm),
        "rotation": _values(pose.rotation),
        "quaternion_wxyz": _values(
            None if pose.rotation is None else rotation_quaternion(pose.rotation)
        ),
        "covariance": _values(pose.covariance),
        "tip_mm": _values(pose.tip_mm),
        "tip_covariance_mm2": _values(pose.tip_covariance_mm2),
        "residual_sigma": sigma if sigma is not None and isfinite(sigma) else None,
        "markers_used": pose.markers_used,
        "readings_used": pose.readings_used,
        "velocity_mm_s": _values(pose.velocity_mm_s),
        "angular_velocity_rad_s": _values(pose.angular_velocity_rad_s),
    }


def _values(array: Array | None) -> list[Any] | None:
    """Return an array as lists; None for what is not known, for which JSON has no number."""
    if array is None or not np.isfinite(array).all():
        return None
    found: list[Any] = array.tolist()
    return found
