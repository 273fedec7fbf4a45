"""Calibration targets and recordings of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.target_shape import (
    KnownDistance,
    TargetShape,
    body_shape,
    line_shape,
)
from compute.camera.model import Vector3
from compute.errors import InvalidParameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Wand:
    """Two or more markers on a straight bar.

    Args:
        position_mm: the markers' positions along it [mm]; (0.0, 300.0) for a bar of 300 mm.
        sigma_mm: standard deviation of each place [mm]; 0: exact.

    Raises:
        InvalidParameter: fewer than two markers, or two that coincide.
    """

    position_mm: tuple[float, ...]
    sigma_mm: float = 0.0

    def __post_init__(self) -> None:
        if len(self.position_mm) < 2:
            raise InvalidParameter(
                f"a wand with {len(self.position_mm)} marker has no length, which leaves "
                "the scale open; give two markers or more, with their positions along it in mm",
                markers=len(self.position_mm),
            )
        if not 0.0 <= self.sigma_mm < np.inf:
            raise InvalidParameter(f"sigma_mm of a wand is {self.sigma_mm}; give 0 or more")
        self.shape()

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.position_mm)

    def shape(self) -> TargetShape:
        """Return the shape that is adjusted."""
        return line_shape(self.position_mm, self.sigma_mm)


@dataclass(frozen=True)
class RigidBody:
    """A rigid body, or a calibration frame, of known shape at unknown poses.

    Args:
        marker_mm: the markers in the body's own frame [mm], three or more, not on a line.
        sigma_mm: standard deviation of each coordinate [mm]; 0: exact.

    Raises:
        InvalidParameter: fewer than three markers, or all on a line.
    """

    marker_mm: tuple[Vector3, ...]
    sigma_mm: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.sigma_mm < np.inf:
            raise InvalidParameter(f"sigma_mm of a rigid body is {self.sigma_mm}; give 0 or more")
        self.shape()

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.marker_mm)

    def shape(self) -> TargetShape:
        """Return the shape that is adjusted."""
        return body_shape(np.array(self.marker_mm), self.sigma_mm)


@dataclass(frozen=True)
class UnknownRigidBody:
    """A rigid body of unknown shape except for one distance, which sets the scale.

    Args:
        markers: how many it has, three or more.
        distance: what is known of two of them.

    Raises:
        InvalidParameter: too few markers, or a distance between others than these.
    """

    markers: int
    distance: KnownDistance

    def __post_init__(self) -> None:
        if self.markers < 3:
            raise InvalidParameter(
                f"a rigid body with {self.markers} markers; give it three or more, or describe "
                "two as a wand",
                markers=self.markers,
            )
        ends = (self.distance.first, self.distance.second)
        if ends[0] == ends[1] or min(ends) < 0 or max(ends) >= self.markers:
            raise InvalidParameter(
                f"the known distance is between markers {ends[0] + 1} and {ends[1] + 1}; it must "
                f"be between two of the {self.markers}",
                markers=self.markers,
            )

    def __len__(self) -> int:
        """Return the number of markers."""
        return self.markers

    def shape(self, marker_mm: Array) -> TargetShape:
        """Return the shape that is adjusted, from a first estimate (K, 3) [mm]."""
        return body_shape(marker_mm, np.inf, (self.distance,))


CalibrationTarget = Wand | RigidBody | UnknownRigidBody


@dataclass(frozen=True, eq=False)
class Recording:
    """Readings of a target at B poses.

    Args:
        target: the target that was moved.
        readings_px: shape (B, K, S) [px]; NaN where a sensor did not see the marker.
        sigma_px: their standard deviations, shape (B, K, S) [px]; None: not known.

    Raises:
        InvalidParameter: shapes that do not fit, infinite readings, or a standard deviation
            that is not positive.
    """

    target: CalibrationTarget
    readings_px: Array
    sigma_px: Array | None = None

    def __post_init__(self) -> None:
        shape = self.readings_px.shape
        if len(shape) != 3 or shape[1] != len(self.target):
            raise InvalidParameter(
                f"readings have shape {shape}; {len(self.target)} markers make "
                f"(poses, {len(self.target)}, sensors)"
            )
        if np.isinf(self.readings_px).any():
            raise InvalidParameter("a reading is infinite; leave out (NaN) what was not seen")
        if self.sigma_px is None:
            return
        if self.sigma_px.shape != shape:
            raise InvalidParameter(
                f"standard deviations have shape {self.sigma_px.shape}, readings {shape}"
            )
        given = self.sigma_px[np.isfinite(self.readings_px)]
        if not ((given > 0.0) & np.isfinite(given)).all():
            raise InvalidParameter("standard deviations must be positive and finite where read")
