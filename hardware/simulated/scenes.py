"""Scenes: where the markers are at a time."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from compute.errors import InvalidParameter
from hardware.simulated.bounds import check_bounds
from hardware.simulated.frame_shape import frame_shape_mm

Array = NDArray[np.float64]
Coordinate = Annotated[float, Field(ge=-1e5, le=1e5)]
Point = tuple[Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class CalibrationFrame:
    """The thesis's pyramidal calibration frame with 19 markers, at rest (Figure 5.8).

    Args:
        centre_mm: where the mean of the 19 markers is [mm].
        scale: size relative to the frame of Test 5.4 (about 270 x 280 x 315 mm).
    """

    kind: Literal["calibration-frame"] = "calibration-frame"
    centre_mm: Point = (0.0, 0.0, 1500.0)
    scale: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def markers(self) -> int:
        """Number of markers."""
        return len(frame_shape_mm())

    def points(self, time_s: float | Array) -> Array:
        """Return the markers at times (...,) [s], shape (..., 19, 3) [mm]."""
        return _at_rest(np.asarray(self.centre_mm) + self.scale * frame_shape_mm(), time_s)


@dataclass(frozen=True)
class StillPoints:
    """Markers at rest at given points.

    Args:
        points_mm: the points in the world frame [mm].
    """

    points_mm: Annotated[tuple[Point, ...], Field(min_length=1, max_length=256)]
    kind: Literal["still-points"] = "still-points"

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def markers(self) -> int:
        """Number of markers."""
        return len(self.points_mm)

    def points(self, time_s: float | Array) -> Array:
        """Return the markers at times (...,) [s], shape (..., M, 3) [mm]."""
        return _at_rest(np.asarray(self.points_mm, dtype=np.float64), time_s)


@dataclass(frozen=True)
class RotatingBar:
    """A bar that turns at constant speed about its middle, a marker at each end (section 6.1.2).

    The turn is right-handed about the normal. At time zero the bar lies along the world's X
    axis, as far as its plane allows (along Y where the normal is X).

    Args:
        length_mm: distance between the two markers [mm].
        period_s: duration of one turn [s].
        centre_mm: middle of the bar [mm].
        plane_normal: normal of the plane of rotation, any length; vertical for a horizontal bar.
    """

    kind: Literal["rotating-bar"] = "rotating-bar"
    length_mm: Annotated[float, Field(gt=0.0, le=1e5)] = 292.0
    period_s: Annotated[float, Field(ge=1e-3, le=1e6)] = 2.0
    centre_mm: Point = (0.0, 0.0, 1500.0)
    plane_normal: Point = (0.0, 1.0, 0.0)

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    def __post_init__(self) -> None:
        check_bounds(self)
        if np.linalg.norm(self.plane_normal) < 1e-6:
            raise InvalidParameter(
                f"plane_normal is {self.plane_normal}; its length must be at least 1e-6",
                plane_normal=self.plane_normal,
            )

    @property
    def markers(self) -> int:
        """Number of markers."""
        return 2

    def points(self, time_s: float | Array) -> Array:
        """Return the markers at times (...,) [s], shape (..., 2, 3) [mm]."""
        normal = np.asarray(self.plane_normal, dtype=np.float64)
        normal /= np.linalg.norm(normal)
        start = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.99 else np.array([0.0, 1.0, 0.0])
        start -= (start @ normal) * normal
        start /= np.linalg.norm(start)
        # The angle is taken within the turn, so that hours later it is as exact as at the start.
        angle = 2.0 * np.pi * (np.asarray(time_s) / self.period_s % 1.0)[..., None]
        half = np.cos(angle) * start + np.sin(angle) * np.cross(normal, start)
        half *= self.length_mm / 2.0
        centre = np.asarray(self.centre_mm)
        return np.stack([centre + half, centre - half], axis=-2)


Scene = Annotated[CalibrationFrame | StillPoints | RotatingBar, Field(discriminator="kind")]


def _at_rest(points_mm: Array, time_s: float | Array) -> Array:
    return np.broadcast_to(points_mm, (*np.shape(time_s), *points_mm.shape))
