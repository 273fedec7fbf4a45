"""Traced readings of points over a sensor's field or a device's cube, and fits to them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.field_distortion import Term
from compute.optics.pixel_row import PixelRow
from compute.optics.sensor_placement import OpticalSensor, place_optics
from compute.optics.stripe_optics.stripe_profile import Blur
from compute.optics.stripe_optics.traced_stripes import TracedStripes
from compute.optics.tracing.assembly import Assembly
from validation.aberrations.thesis_lens import (
    FOCUSED_MM,
    ROW,
    row_behind_mm,
)
from validation.skew_effect.field_distortion_fit import FieldFit, FieldModel, fit_field_model
from validation.thesis_data import load_cameras

if TYPE_CHECKING:
    from compute.camera.model import Vector3

Array = NDArray[np.float64]

FIELD_U: Final = 0.375
"""x/z that the ends of the row see."""
FIELD_V: Final = float(np.tan(np.radians(20.0)))
DISTANCES_MM: Final = (1000.0, 2000.0)
CUBE_MM: Final = ((-2000.0, -1500.0), (-250.0, 250.0), (-250.0, 250.0))
"""Appendix F: the 12 points lie from 1500 to 1900 mm before the device, in a cube of 500 mm."""

# The row is traced so much longer than it is that no line is cut: those of the whole lens reach
# 5000 px from its middle.
LONG_ROW: Final = PixelRow(16 * ROW.count, ROW.pitch_um, ROW.height_um)


@dataclass(frozen=True, eq=False)
class Readings:
    """Points in a sensor's frame, shape (N, 3) [mm], and their traced centroids (N,) [px]."""

    points_mm: Array
    centroid_px: Array


def traced_readings(assembly: Assembly, points_mm: Array) -> Readings:
    """Trace the centroids of points (N, 3) in the sensor's frame; those unseen are left out."""
    lines = TracedStripes(assembly, LONG_ROW, Blur(None, 0.0)).shapes(points_mm)
    reading = lines.centroid_px - (LONG_ROW.centre_px - ROW.centre_px)
    seen = (reading >= -0.5) & (reading <= ROW.count - 0.5)
    return Readings(points_mm[seen], reading[seen])


def field_points(counts: tuple[int, int, int]) -> Array:
    """Return a grid over the whole field of a sensor, shape (N, 3) [mm]."""
    u = np.linspace(-FIELD_U, FIELD_U, counts[0])
    v = np.linspace(-FIELD_V, FIELD_V, counts[1])
    inverse = np.linspace(1.0 / DISTANCES_MM[1], 1.0 / DISTANCES_MM[0], counts[2])
    return _in_space(*(g.ravel() for g in np.meshgrid(u, v, 1.0 / inverse, indexing="ij")))


def other_field_points(count: int) -> Array:
    """Return points anywhere in the field, in none of the grid's places, shape (N, 3) [mm]."""
    u, v, z = np.random.default_rng(2).uniform(-1.0, 1.0, (3, count))
    near, far = DISTANCES_MM
    return _in_space(FIELD_U * u, FIELD_V * v, 0.5 * (near + far) + 0.5 * (far - near) * z)


def cube_points(count: int) -> Array:
    """Return a grid of count^3 points in the device's cube, in the world, shape (N, 3) [mm]."""
    axes = [np.linspace(low, high, count) for low, high in CUBE_MM]
    return np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1)


def other_cube_points(count: int) -> Array:
    """Return points anywhere in the device's cube, shape (N, 3) [mm]."""
    low, high = np.array(CUBE_MM).T
    return np.random.default_rng(3).uniform(low, high, (count, 3))


def device_sensors(assembly: Assembly) -> tuple[OpticalSensor, ...]:
    """Return the four sensors of Figure 5.2, their directions those of Test 5.2's cameras."""
    sensors = []
    for number, camera in enumerate(load_cameras("5.2"), start=1):
        x, y, z = camera.centre_mm
        aim: Vector3 = (x - FOCUSED_MM, y, z)
        sensors.append(
            place_optics(
                f"sensor {number}",
                position_mm=camera.centre_mm,
                aim_mm=aim,
                measured_direction=camera.along,
                assembly=assembly,
                row=ROW,
            )
        )
    return tuple(sensors)


def fitted(assembly: Assembly, known: Readings, terms: tuple[Term, ...]) -> FieldFit:
    """Fit a model with these terms to traced readings in the sensor's frame."""
    behind = row_behind_mm(assembly)
    start = FieldModel(behind / ROW.pitch_mm, ROW.centre_px, row_behind_mm=behind)
    return fit_field_model(known.points_mm, known.centroid_px, start, terms)


def left_out_px(fit: FieldFit, other: Readings) -> Array:
    """Return what a fit leaves at points that it never saw, shape (N,) [px]."""
    rest: Array = other.centroid_px - fit.model.readings_px(other.points_mm)
    return rest


def _in_space(u: Array, v: Array, z: Array) -> Array:
    return np.stack([u * z, v * z, z], axis=1)
