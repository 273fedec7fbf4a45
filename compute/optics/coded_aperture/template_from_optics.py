"""Templates of coded windows' shadows, computed from the optics."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.parameter_checks import require, require_shape
from compute.signal.coded_aperture.shadow_template import ShadowTemplate, interleave_scans

Array = NDArray[np.float64]

_STEPS: Final = 4  # of Newton's method; the reading is nearly linear in the point
_REACHED_PX: Final = 1e-3
_PROBE_MM: Final = 1.0


def mask_template(optics: MaskOptics, point_mm: ArrayLike, sensor: int) -> ShadowTemplate:
    """Return the shadow template of a reference point, pixel by pixel.

    Args:
        optics: the windows.
        point_mm: the reference point in the world, on the sensor's axis best, shape (3,) [mm].
        sensor: number of the sensor, from 0.

    Raises:
        InvalidParameter: no such sensor, or a point without a shadow on its sensor.
    """
    point = _vector(point_mm=point_mm)
    reading = _reading(optics, point, sensor)
    shadow = optics.solid_angles(point[None]).solid_angle_sr[0, sensor]
    if not np.ptp(shadow) > 0.0:
        raise InvalidParameter(
            f"point_mm is {point.tolist()}; it throws no shadow on the line of sensor {sensor}: "
            "give a point in front of it, near its axis",
            point_mm=point.tolist(),
        )
    return ShadowTemplate(shadow, 1, 0, reading, dark_beyond=False)


def template_from_optics(
    optics: MaskOptics,
    point_mm: ArrayLike,
    *,
    sensor: int,
    direction: ArrayLike,
    per_px: int = 4,
    far_px: Sequence[int] = (0,),
    dark_beyond: bool = False,
) -> ShadowTemplate:
    """Return the shadow template of a reference point.

    Its shadow is worked out for points displaced along a direction, whose readings are parts of
    a pixel apart, and woven into one pattern: what a pixel gets that lies anywhere in it.

    Args:
        optics: the windows.
        point_mm: the reference point in the world, shape (3,) [mm]; the middle of the working
            volume, best near the sensor's axis.
        sensor: number of the sensor, from 0.
        direction: world direction in which the sensor's readings change, any length, shape (3,).
        per_px: cells of the template per pixel.
        far_px: whole shifts at which the shadow is taken too, 0 among them; where the pattern is
            longer than the line, these tell more of it. Far from the reference point it is that
            of other angles, so more of the pattern is not always a better template.
        dark_beyond: nothing but ambient light beyond the pattern; False where it goes on.

    Raises:
        InvalidParameter: no such sensor, a point that throws no shadow, or a direction in which
            the readings do not change.
    """
    point = _vector(point_mm=point_mm)
    reading = _reading(optics, point, sensor)
    shifts = np.array([far - cell / per_px for far in far_px for cell in range(per_px)])
    points = _displaced(optics, point, _vector(direction=direction), sensor, shifts)
    light = optics.solid_angles(points).solid_angle_sr[:, sensor]
    return interleave_scans(
        light, shifts, reading_px=reading, per_px=per_px, dark_beyond=dark_beyond
    )


def _vector(**values: ArrayLike) -> Array:
    ((name, value),) = values.items()
    vector = np.asarray(value, dtype=np.float64)
    require_shape(vector.shape == (3,), "be (3,)", **{name: vector})
    return vector


def _reading(optics: MaskOptics, point: Array, sensor: int) -> float:
    readings = optics.readings(point[None])[0]
    require(0 <= sensor < len(readings), f"be 0 to {len(readings) - 1}", sensor=sensor)
    return float(readings[sensor])


def _displaced(
    optics: MaskOptics, point: Array, direction: Array, sensor: int, shifts_px: Array
) -> Array:
    """Return points whose readings differ by these shifts, shape (K, 3) [mm].

    Raises:
        InvalidParameter: the readings do not change along the direction, or no point along it has
            its shadow as far as a shift reaches.
    """
    length = float(np.linalg.norm(direction))
    probe = point + direction * (_PROBE_MM / length) if length > 0.0 else point
    start, moved = (float(optics.readings(one[None])[0, sensor]) for one in (point, probe))
    per_mm = (moved - start) / _PROBE_MM
    if not (np.isfinite(per_mm) and per_mm != 0.0):
        raise InvalidParameter(
            f"point_mm is {point.tolist()} and direction {direction.tolist()}; the readings of "
            f"sensor {sensor} must change from a point in front of it along the direction",
            point_mm=point.tolist(),
            direction=direction.tolist(),
        )
    unit, target, distance_mm = direction / length, start + shifts_px, np.zeros(len(shifts_px))
    for _ in range(_STEPS):
        reached = optics.readings(point + distance_mm[:, None] * unit)[:, sensor]
        distance_mm += (target - reached) / per_mm
    points = point + distance_mm[:, None] * unit
    distance = np.abs(optics.readings(points)[:, sensor] - target)
    if not (distance <= _REACHED_PX).all():
        raise InvalidParameter(
            f"far_px reaches to {float(np.abs(shifts_px).max())} px, where no point in front of "
            f"sensor {sensor} along the direction has its shadow; give smaller shifts",
            far_px=float(np.abs(shifts_px).max()),
        )
    return np.asarray(points)
