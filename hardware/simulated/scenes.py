"""Scenes: marker positions as functions of time."""

from dataclasses import dataclass
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from compute.errors import InvalidParameter
from hardware.field_bounds import FIRST_ERROR_ONLY, CheckedSettings
from hardware.simulated.calibration_target import calibration_target_points_mm

Array = NDArray[np.float64]
Coordinate = Annotated[float, Field(ge=-1e5, le=1e5)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Angle = Annotated[float, Field(ge=-10.0, le=10.0)]
RotationVector = tuple[Angle, Angle, Angle]

# Swings in a period about X, Y, Z, all different, and where in a swing each begins.
_PATH_RATES: Final = (1.0, 2.0, 3.0)
_PATH_PHASES: Final = (0.0, 0.125, 0.25)
_ROTATION_RATES: Final = (2.0, 3.0, 1.0)
_ROTATION_PHASES: Final = (0.0, 0.25, 0.125)
# Of a waved wand: swings in a period, and turns of its direction from pole to pole and round it.
_WAVE_RATES: Final = (5.0, 4.0, 3.0)
_WAVE_PHASES: Final = (0.0, 0.125, 0.25)
_WAVE_ROTATION_RATES: Final = (2.0, 7.0)


@dataclass(frozen=True)
class CalibrationTarget(CheckedSettings):
    """The thesis's pyramidal calibration frame with 19 markers, at rest (Figure 5.8).

    Args:
        centre_mm: where the mean of the 19 markers is [mm].
        scale: size relative to the frame of Test 5.4 (about 270 x 280 x 315 mm).
    """

    kind: Literal["calibration-frame"] = "calibration-frame"
    centre_mm: Point = (0.0, 0.0, 1500.0)
    scale: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0

    @property
    def markers(self) -> int:
        """Number of markers."""
        return len(calibration_target_points_mm())

    def points(self, time_s: float | Array) -> Array:
        """Return the markers at times (...,) [s], shape (..., 19, 3) [mm]."""
        return _at_rest(
            np.asarray(self.centre_mm) + self.scale * calibration_target_points_mm(), time_s
        )


@dataclass(frozen=True)
class StillPoints(CheckedSettings):
    """Markers at rest at given points.

    Args:
        points_mm: the points in the world frame [mm].
    """

    points_mm: Annotated[tuple[Point, ...], Field(min_length=1, max_length=256), FIRST_ERROR_ONLY]
    kind: Literal["still-points"] = "still-points"

    @property
    def markers(self) -> int:
        """Number of markers."""
        return len(self.points_mm)

    def points(self, time_s: float | Array) -> Array:
        """Return the markers at times (...,) [s], shape (..., M, 3) [mm]."""
        return _at_rest(np.asarray(self.points_mm, dtype=np.float64), time_s)


@dataclass(frozen=True)
class ShiftedPoints(CheckedSettings):
    """Markers on somebody who rests, and moves aside for the last part of every period.

    Args:
        points_mm: the markers at rest, in the world [mm].
        shift_mm: how far they move, all alike [mm].
        period_s: from one movement to the next [s].
        away: part of the period from leaving the place to being back.
        moving_s: how long each way takes, at constant speed [s].
    """

    points_mm: Annotated[tuple[Point, ...], Field(min_length=1, max_length=64), FIRST_ERROR_ONLY]
    shift_mm: Point = (5.0, 0.0, 0.0)
    period_s: Annotated[float, Field(ge=1e-3, le=1e6)] = 10.0
    away: Annotated[float, Field(ge=1e-3, le=1.0)] = 0.4
    moving_s: Annotated[float, Field(ge=1e-7, le=1e6)] = 0.1
    kind: Literal["shifted-points"] = "shifted-points"

    def __post_init__(self) -> None:
        super().__post_init__()
        if 2.0 * self.moving_s > self.away * self.period_s:
            raise InvalidParameter(
                f"moving_s is {self.moving_s}; there and back it must be within the "
                f"{self.away * self.period_s:g} s of a period away from the place",
                moving_s=self.moving_s,
            )

    @property
    def markers(self) -> int:
        """Number of markers."""
        return len(self.points_mm)

    def shift(self, time_s: float | Array) -> Array:
        """Return the displacement at times (...,) [s], shape (..., 3) [mm]."""
        at = np.asarray(time_s, dtype=np.float64) % self.period_s
        departure = np.clip((at - (1.0 - self.away) * self.period_s) / self.moving_s, 0.0, 1.0)
        back = np.clip((at - (self.period_s - self.moving_s)) / self.moving_s, 0.0, 1.0)
        shift: Array = (departure - back)[..., None] * np.asarray(self.shift_mm)
        return shift

    def points(self, time_s: float | Array) -> Array:
        """Return the markers at times (...,) [s], shape (..., M, 3) [mm]."""
        return np.asarray(self.points_mm, dtype=np.float64) + self.shift(time_s)[..., None, :]


@dataclass(frozen=True)
class RotatingBar(CheckedSettings):
    """A bar that turns at constant speed about its middle, a marker at each end (section 6.1.2).

    The rotation is right-handed about the normal. At time zero the bar lies along the world's X
    axis, as far as its plane allows (along Y where the normal is X).

    Args:
        length_mm: distance between the two markers [mm].
        period_s: duration of one revolution [s].
        centre_mm: middle of the bar [mm].
        plane_normal: normal of the plane of rotation, any length; vertical for a horizontal bar.
    """

    kind: Literal["rotating-bar"] = "rotating-bar"
    length_mm: Annotated[float, Field(gt=0.0, le=1e5)] = 292.0
    period_s: Annotated[float, Field(ge=1e-3, le=1e6)] = 2.0
    centre_mm: Point = (0.0, 0.0, 1500.0)
    plane_normal: Point = (0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
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
        # Within the revolution, so that hours later it is as exact as at the start.
        angle = 2.0 * np.pi * (np.asarray(time_s) / self.period_s % 1.0)[..., None]
        half = np.cos(angle) * start + np.sin(angle) * np.cross(normal, start)
        half *= self.length_mm / 2.0
        centre = np.asarray(self.centre_mm)
        return np.stack([centre + half, centre - half], axis=-2)


@dataclass(frozen=True)
class MovingTool(CheckedSettings):
    """A rigid tool that is moved smoothly in all six degrees of freedom.

    Its point ``held_mm`` goes along a Lissajous curve about ``centre_mm``, and the components of
    its rotation swing likewise, at other rates: nothing repeats before the period.

    Args:
        markers_mm: its markers in its own coordinates [mm].
        centre_mm: middle of the curve, in the world [mm].
        swing_mm: how far the curve goes to either side, along X, Y, Z [mm]; zeros: the point
            stays, as the tip of a pointer that is pivoted.
        turn_rad: amplitude of the rotation, components of a rotation vector [rad].
        rest_rad: the orientation that it swings about, a rotation vector [rad].
        held_mm: the point that goes along the curve, in the tool's coordinates [mm].
        period_s: duration of the whole motion [s].
        phase: where in it the motion begins, as a part of the period.
    """

    markers_mm: Annotated[tuple[Point, ...], Field(min_length=1, max_length=64), FIRST_ERROR_ONLY]
    centre_mm: Point = (0.0, 0.0, 1500.0)
    swing_mm: Point = (120.0, 90.0, 60.0)
    turn_rad: RotationVector = (0.4, 0.5, 0.6)
    rest_rad: RotationVector = (0.0, 0.0, 0.0)
    held_mm: Point = (0.0, 0.0, 0.0)
    period_s: Annotated[float, Field(ge=1e-3, le=1e6)] = 6.0
    phase: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0

    def pose(self, time_s: float | Array) -> tuple[Array, Array]:
        """Return R_world_tool, shape (..., 3, 3), and the origin, shape (..., 3) [mm], then."""
        # Within the period, so that hours later it is as exact as at the start.
        at = (np.asarray(time_s, dtype=np.float64) / self.period_s + self.phase) % 1.0
        swing = np.asarray(self.turn_rad) * _swings(at, _ROTATION_RATES, _ROTATION_PHASES)
        rotation = rotation_of(swing) @ rotation_of(np.asarray(self.rest_rad))
        path = np.asarray(self.swing_mm) * _swings(at, _PATH_RATES, _PATH_PHASES)
        return rotation, np.asarray(self.centre_mm) + path - rotation @ np.asarray(self.held_mm)


@dataclass(frozen=True)
class MovingTools(CheckedSettings):
    """Rigid tools in motion; their markers are numbered tool by tool, in order.

    Args:
        tools: the tools.
        moving: False: they rest where they are at time zero.
    """

    tools: Annotated[tuple[MovingTool, ...], Field(min_length=1, max_length=16), FIRST_ERROR_ONLY]
    moving: bool = True
    kind: Literal["moving-tools"] = "moving-tools"

    @property
    def markers(self) -> int:
        """Number of markers of all tools."""
        return sum(len(tool.markers_mm) for tool in self.tools)

    @property
    def period_s(self) -> float:
        """Duration of the slowest tool's motion [s]."""
        return max(tool.period_s for tool in self.tools)

    def numbers(self, tool: int) -> tuple[int, ...]:
        """Return the indices of a tool's markers among all: its strobe slots."""
        first = sum(len(one.markers_mm) for one in self.tools[:tool])
        return tuple(range(first, first + len(self.tools[tool].markers_mm)))

    def pose(self, tool: int, time_s: float | Array) -> tuple[Array, Array]:
        """Return R_world_tool, shape (..., 3, 3), and the origin, shape (..., 3) [mm], then."""
        return self.tools[tool].pose(time_s if self.moving else np.zeros(np.shape(time_s)))

    def points(self, time_s: float | Array) -> Array:
        """Return the markers at times (...,) [s], shape (..., M, 3) [mm]."""
        positions = []
        for index, tool in enumerate(self.tools):
            rotation, origin = self.pose(index, time_s)
            markers = np.asarray(tool.markers_mm, dtype=np.float64)
            positions.append(markers @ np.swapaxes(rotation, -1, -2) + origin[..., None, :])
        return np.concatenate(positions, axis=-2)


@dataclass(frozen=True)
class WavedWand(CheckedSettings):
    """A wand of two markers that is waved through a volume in all directions, for calibration.

    Its middle goes along a Lissajous curve; its direction goes from pole to pole of the sphere
    and round it meanwhile, smoothly. Nothing repeats before the period.

    Args:
        length_mm: distance between the two markers [mm].
        centre_mm: middle of the curve, in the world [mm].
        swing_mm: how far the curve goes to either side, along X, Y, Z [mm].
        period_s: duration of the whole motion [s].
    """

    kind: Literal["waved-wand"] = "waved-wand"
    length_mm: Annotated[float, Field(gt=0.0, le=1e5)] = 300.0
    centre_mm: Point = (0.0, 0.0, 1500.0)
    swing_mm: Point = (250.0, 250.0, 300.0)
    period_s: Annotated[float, Field(ge=1e-3, le=1e6)] = 30.0

    @property
    def markers(self) -> int:
        """Number of markers."""
        return 2

    def points(self, time_s: float | Array) -> Array:
        """Return the markers at times (...,) [s], shape (..., 2, 3) [mm]."""
        # Within the period, so that hours later it is as exact as at the start.
        at = np.asarray(time_s, dtype=np.float64) / self.period_s % 1.0
        path = np.asarray(self.swing_mm) * _swings(at, _WAVE_RATES, _WAVE_PHASES)
        polar, azimuth = (2.0 * np.pi * rate * at for rate in _WAVE_ROTATION_RATES)
        along = np.stack(
            [np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), np.sin(polar)],
            axis=-1,
        )
        middle = np.asarray(self.centre_mm) + path
        half = 0.5 * self.length_mm * along
        return np.stack([middle - half, middle + half], axis=-2)


@dataclass(frozen=True)
class EvenLight(CheckedSettings):
    """Even light on all pixels and no marker, for radiometric calibration.

    It takes the place of the ambient light.

    Args:
        electrons: mean electrons in a nominal pixel and exposure; 0: the sensors are covered.
    """

    electrons: Annotated[float, Field(ge=0.0, le=1e6)] = 0.0
    kind: Literal["even-light"] = "even-light"

    @property
    def markers(self) -> int:
        """Number of markers: none."""
        return 0

    def points(self, time_s: float | Array) -> Array:
        """Return no markers at times (...,) [s], shape (..., 0, 3) [mm]."""
        return np.empty((*np.shape(time_s), 0, 3))


Scene = Annotated[
    CalibrationTarget
    | StillPoints
    | ShiftedPoints
    | RotatingBar
    | MovingTools
    | WavedWand
    | EvenLight,
    Field(discriminator="kind"),
]


def _at_rest(points_mm: Array, time_s: float | Array) -> Array:
    return np.broadcast_to(points_mm, (*np.shape(time_s), *points_mm.shape))


def _swings(at: Array, rates: tuple[float, ...], phases: tuple[float, ...]) -> Array:
    """Return three sines at each fraction of the period (...,), shape (..., 3)."""
    values: Array = np.sin(2.0 * np.pi * (at[..., None] * np.array(rates) + np.array(phases)))
    return values


def rotation_of(vector_rad: Array) -> Array:
    """Return rotation matrices of rotation vectors (..., 3), shape (..., 3, 3) (Rodrigues)."""
    angle = np.linalg.norm(vector_rad, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector_rad, -1, 0)
    none = np.zeros_like(x)
    rows = [[none, -z, y], [z, none, -x], [-y, x, none]]
    cross = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    # sin(a)/a and (1 - cos(a))/a^2 without a division by zero.
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    rotation: Array = np.eye(3) + first * cross + second * (cross @ cross)
    return rotation
