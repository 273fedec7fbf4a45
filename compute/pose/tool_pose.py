"""ToolPose: pose of a tool at a time with its uncertainty, or the reason why there is none."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PoseStatus(StrEnum):
    """Status of a pose, in the terms of OpenIGTLink and PLUS."""

    OK = "OK"
    """The pose is what the covariance says."""
    MISSING = "MISSING"
    """Nothing, or too little, was seen of the tool: there is no pose."""
    OUT_OF_VIEW = "OUT_OF_VIEW"
    """The tool was last seen leaving the sensors' fields: there is no pose."""
    OUT_OF_VOLUME = "OUT_OF_VOLUME"
    """There is a pose, outside of the volume in which the calibration or table is valid."""
    INVALID = "INVALID"
    """What was seen does not fit the tool, or two tools fit it: a pose there may be is not one to
    use."""
    HIGH_ERROR = "HIGH_ERROR"
    """There is a pose, and its uncertainty or its residual is above the tool's limit."""
    UNKNOWN = "UNKNOWN"
    """The tool was not looked for yet."""


@dataclass(frozen=True, eq=False)
class ToolPose:
    """The pose of one tool at one time.

    ``x_world = rotation @ x_tool + translation_mm``.

    Args:
        tool: the tool's name.
        status: only OK, HIGH_ERROR and OUT_OF_VOLUME have a pose.
        reason: why the status is not OK, in words; None if it is.
        exposure_ns: middle of the exposure on the host's clock [ns], as time.time_ns() counts.
        sequence: number of the frame.
        rotation: R_world_tool, shape (3, 3); None without a pose.
        translation_mm: the tool's origin in the world, shape (3,) [mm]; None without a pose.
        covariance: covariance of a small rotation [rad] about the world's axes, on the left, and
            of the translation [mm], in this order, shape (6, 6); None without a pose.
        tip_mm: tip in the world, shape (3,) [mm]; None without a pose.
        tip_covariance_mm2: its covariance, shape (3, 3) [mm^2]; None without a pose.
        residual_sigma: root of chi2 per degree of freedom of the readings; None without any.
        markers_used: number of markers that the pose comes from.
        readings_used: number of readings that it comes from.
        velocity_mm_s: velocity of the tool's origin, shape (3,) [mm/s]; None: not estimated.
        angular_velocity_rad_s: about the world's axes, shape (3,) [rad/s]; None: not estimated.
        unseen_ns: time since the last reading, over which the pose is predicted [ns].
    """

    tool: str
    status: PoseStatus
    reason: str | None
    exposure_ns: int
    sequence: int
    rotation: Array | None = None
    translation_mm: Array | None = None
    covariance: Array | None = None
    tip_mm: Array | None = None
    tip_covariance_mm2: Array | None = None
    residual_sigma: float | None = None
    markers_used: int = 0
    readings_used: int = 0
    velocity_mm_s: Array | None = None
    angular_velocity_rad_s: Array | None = None
    unseen_ns: int = 0

    @property
    def valid(self) -> bool:
        """Whether it may be used for navigation: its status is OK."""
        return self.status is PoseStatus.OK
