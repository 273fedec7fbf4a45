"""Shadows of coded windows to test with: templates and lines from the optics."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from compute.optics.coded_aperture.coded_window import CodedWindow, maximal_length_code
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.signal.coded_aperture.shadow_template import ShadowTemplate, interleave_scans
from tests.compute.optics.coded_aperture.mask_sensors import sensor_behind

Array = NDArray[np.float64]

PIXELS = 1024
DISTANCE_MM = 2000.0


@lru_cache(maxsize=1)
def window_optics() -> MaskOptics:
    """63 bars of 100 um behind a gap of 10 mm, 0.9 um light, pixels of 10 um."""
    return MaskOptics(
        CodedWindow(maximal_length_code(6), 0.1, 10.0, 3.0, 1.5),
        [sensor_behind(10.0, pixels=PIXELS)],
        pixel_height_mm=0.2,
        emitter_width_mm=0.5,
        wavelength_nm=900.0,
        spectral_width_nm=50.0,
    )


def displaced(
    optics: MaskOptics,
    shifts_px: Sequence[float] | Array,
    point_mm: Sequence[float] | Array = (0.0, 0.0, DISTANCE_MM),
    sensor: int = 0,
    direction: Sequence[float] = (1.0, 0.0, 0.0),
) -> Array:
    """Points along a direction whose readings are so much from the point's, (K, 3)."""
    point, way = np.asarray(point_mm, float), np.asarray(direction, float)
    start = float(optics.readings(point[None])[0, sensor])
    wanted = start + np.asarray(shifts_px, float)
    moved = np.zeros(len(wanted))
    per_mm = float(optics.readings((point + way)[None])[0, sensor]) - start
    for _ in range(4):
        reached = optics.readings(point + moved[:, None] * way)[:, sensor]
        moved += (wanted - reached) / per_mm
    return np.asarray(point + moved[:, None] * way)


def shadows(
    optics: MaskOptics,
    shifts_px: Sequence[float] | Array,
    point_mm: Sequence[float] | Array = (0.0, 0.0, DISTANCE_MM),
    sensor: int = 0,
    direction: Sequence[float] = (1.0, 0.0, 0.0),
) -> tuple[Array, float]:
    """Lines of such points, (K, P), and the reading of the point itself."""
    points = displaced(optics, shifts_px, point_mm, sensor, direction)
    lines = optics.solid_angles(points).solid_angle_sr[:, sensor]
    return lines, float(optics.readings(np.asarray(point_mm, float)[None])[0, sensor])


def woven(
    optics: MaskOptics,
    per_px: int,
    point_mm: Sequence[float] | Array = (0.0, 0.0, DISTANCE_MM),
    *,
    sensor: int = 0,
    direction: Sequence[float] = (1.0, 0.0, 0.0),
    far_px: Sequence[int] = (0,),
    dark_beyond: bool = True,
) -> ShadowTemplate:
    """Template of a point; with shadows shifted far, where the pattern is longer than a line."""
    shifts = np.array([far - k / per_px for far in far_px for k in range(per_px)])
    lines, reading = shadows(optics, shifts, point_mm, sensor, direction)
    return interleave_scans(
        lines, shifts, reading_px=reading, per_px=per_px, dark_beyond=dark_beyond
    )
