"""RigidBody: markers of a tool; CentredMarkers: the same about their centroid; ToolPose."""

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.transform import Transform, hat_so3

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A tool's markers, tip and name.

    Args:
        name: unique among the tools of a device; letters, digits, "_" and "-".
        markers_mm: M markers in the tool's coordinates, shape (M, 3) [mm].
        strobe_markers: number of each marker's strobe slot or blinking code, M of them, all
            different; None: the markers are lit together and identified by their geometry.
        tip_mm: the tip in the tool's coordinates [mm]; None: its origin.
        max_tip_sd_mm: 3D standard deviation of the tip above which a pose is HIGH_ERROR [mm];
            None: that of the tracker's settings.
    """

    name: str
    markers_mm: Array
    strobe_markers: tuple[int, ...] | None = None
    tip_mm: Vector3 | None = None
    max_tip_sd_mm: float | None = None

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.markers_mm)


_IDENTITY = np.eye(3)
COLLINEARITY_RATIO = 1e-3
"""Points whose extent across their line is below this fraction of that along it are collinear."""


@dataclass(frozen=True, eq=False)
class CentredMarkers:
    """A tool's coordinates relative to the centroid of its markers.

    The tool's origin may be a metre from its markers, where a rotation moves them all. About the
    centroid, rotation and translation are least correlated, so fits and filters work there.

    Args:
        centroid_mm: centroid in the tool's coordinates, shape (3,) [mm].
        markers_mm: markers less the centroid, shape (M, 3) [mm].
        radius_mm: RMS distance of the markers from the centroid [mm]; it converts rad to mm.
        tip_mm: tip less the centroid, shape (3,) [mm].
        collinear: whether the markers are on a line.
    """

    centroid_mm: Array
    markers_mm: Array
    radius_mm: float
    tip_mm: Array
    collinear: bool

    @classmethod
    @lru_cache(maxsize=256)
    def of(cls, tool: RigidBody) -> "CentredMarkers":
        """Return the centred markers of a tool; they are cached, as tools do not change."""
        markers = np.asarray(tool.markers_mm, dtype=np.float64)
        centroid = markers.mean(axis=0)
        about = markers - centroid
        tip = np.zeros(3) if tool.tip_mm is None else np.array(tool.tip_mm)
        radius = float(np.sqrt((about**2).sum(axis=1).mean()))
        return cls(centroid, about, radius, tip - centroid, are_collinear(markers))

    def translation(self, rotation: Array, centroid_mm: Array) -> Array:
        """Return the tool's origin in the world, shape (3,) [mm].

        Args:
            rotation: R_world_tool, shape (3, 3).
            centroid_mm: centroid of the markers in the world, shape (3,) [mm].
        """
        origin: Array = centroid_mm - rotation @ self.centroid_mm
        return origin

    def centroid(self, rotation: Array, translation_mm: Array) -> Array:
        """Return the centroid of the markers in the world, shape (3,) [mm].

        Args:
            rotation: R_world_tool, shape (3, 3).
            translation_mm: the tool's origin in the world, shape (3,) [mm].
        """
        centroid: Array = translation_mm + rotation @ self.centroid_mm
        return centroid

    def origin_jacobian(self, rotation: Array) -> Array:
        """Return d (rotation, origin) / d (rotation, centroid), shape (6, 6)."""
        jacobian = np.eye(6)
        # A rotation w moves the origin, which is at -R c from the centroid, by w x (-R c).
        jacobian[3:, :3] = hat_so3(rotation @ self.centroid_mm)
        return jacobian

    def tip_jacobian(self, rotation: Array) -> Array:
        """Return d tip / d (rotation, centroid), shape (3, 6)."""
        jacobian = np.empty((3, 6))
        jacobian[:, :3] = -hat_so3(rotation @ self.tip_mm)
        jacobian[:, 3:] = _IDENTITY
        return jacobian


def are_collinear(points_mm: Array) -> bool:
    """Return whether points (N, 3) are on a line, or are fewer than three."""
    if len(points_mm) < 3:
        return True
    extent = np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)
    return bool(extent[1] <= COLLINEARITY_RATIO * extent[0])


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
    """The readings do not fit the tool, or two tools fit it: a pose there may be is not one to
    use."""
    HIGH_ERROR = "HIGH_ERROR"
    """There is a pose, and its uncertainty or its residual is above the tool's limit."""
    LOW_RELIABILITY = "LOW_RELIABILITY"
    """There is a pose, and too few other readings check each of its readings: a wrong one could
    pass unnoticed."""
    UNKNOWN = "UNKNOWN"
    """The tool has not been searched for yet."""


@dataclass(frozen=True, eq=False)
class ToolPose:
    """The pose of one tool at one time.

    ``x_world = rotation @ x_tool + translation_mm``.

    Args:
        tool: the tool's name.
        status: only OK, HIGH_ERROR, OUT_OF_VOLUME and LOW_RELIABILITY have a pose.
        reason: why the status is not OK, in words; None if it is.
        exposure_ns: middle of the exposure on the host's clock [ns], as time.time_ns() counts.
        sequence: number of the frame.
        rotation: R_world_tool, shape (3, 3); None without a pose.
        translation_mm: the tool's origin in the world, shape (3,) [mm]; None without a pose.
        covariance: covariance of a small rotation [rad] about the world's axes, on the left, and
            of the translation [mm], in this order, shape (6, 6); None without a pose, and with
            markers beyond the correction table.
        tip_mm: tip in the world, shape (3,) [mm]; None without a pose.
        tip_covariance_mm2: its covariance, shape (3, 3) [mm^2]; None likewise.
        residual_sigma: root of chi2 per degree of freedom of the readings; None without any.
        markers_used: number of markers that the pose comes from.
        readings_used: number of readings that it comes from.
        velocity_mm_s: velocity of the tool's origin, shape (3,) [mm/s]; None: not estimated.
        angular_velocity_rad_s: about the world's axes, shape (3,) [rad/s]; None: not estimated.
        unseen_ns: time since the last reading, over which the pose is predicted [ns].
        detectable_sigma: error of a reading, in its standard deviations, from which on it is found
            with a probability of 0.8 whichever reading it is; None without a pose, infinite where
            nothing checks a reading.
        external_tip_mm: largest shift of the tip by a smaller error of one reading [mm]; likewise.
        external_rotation_rad: largest rotation by one [rad]; likewise.
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
    detectable_sigma: float | None = None
    external_tip_mm: float | None = None
    external_rotation_rad: float | None = None

    @property
    def valid(self) -> bool:
        """Whether it may be used for navigation: its status is OK."""
        return self.status is PoseStatus.OK

    def transform(self) -> Transform:
        """Return T_world_tool.

        Raises:
            InvalidParameter: the pose is not known.
        """
        if self.rotation is None or self.translation_mm is None:
            raise InvalidParameter(
                f'tool "{self.tool}" has no pose in frame {self.sequence}: it is '
                f"{self.status.value} ({self.reason})"
            )
        return Transform(self.rotation, self.translation_mm, self.covariance)
