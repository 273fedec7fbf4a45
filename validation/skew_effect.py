"""Case skew-effect: what a camera, a polynomial in u, and terms in u and v leave of distortion."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.aberrations.field_distortion import Term, all_terms, power_terms
from compute.optics.aberrations.field_fit import FieldFit, FieldModel, fit_field_model
from compute.optics.aberrations.skew_rays import effective_index, in_plane_stack
from compute.optics.line_optics.exact import Fineness, TracedLines
from compute.optics.line_optics.line_shape import Blur
from compute.optics.line_optics.sensor import OpticalSensor, place_optics
from compute.optics.pixel_row import PixelRow
from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.trace import trace_rays
from validation.aberrations_lens import (
    FOCUSED_MM,
    INDEX,
    RADIUS_MM,
    ROW,
    WIDTH_MM,
    StopPlace,
    row_behind_mm,
    stopped_lens,
)
from validation.tables import Cell, ResultTable, TablesCase
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

MODELS: Final[dict[str, tuple[Term, ...]]] = {
    "7 parameters": (),
    "+ u^3 u^5 u^7": power_terms(7, odd_only=True),
    "+ u^3 to u^7": power_terms(7, odd_only=False),
    "+ u, v, order 5": all_terms(5),
    "+ u, v, order 7": all_terms(7),
}

# The row is traced longer than it is, so that the sensor's end does not cut the lines there.
_LONG_ROW: Final = PixelRow(2 * ROW.count, ROW.pitch_um, ROW.height_um)
_RAYS: Final = Fineness(33)


@dataclass(frozen=True, eq=False)
class Readings:
    """Points in a sensor's frame, shape (N, 3) [mm], and their traced centroids (N,) [px]."""

    points_mm: Array
    centroid_px: Array


def traced_readings(assembly: Assembly, points_mm: Array) -> Readings:
    """Trace the centroids of points (N, 3) in the sensor's frame; those unseen are left out."""
    lines = TracedLines(assembly, _LONG_ROW, Blur(None, 0.0), _RAYS).shapes(points_mm)
    reading = lines.centroid_px - (_LONG_ROW.middle_px - ROW.middle_px)
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
    start = FieldModel(behind / ROW.pitch_mm, ROW.middle_px, row_behind_mm=behind)
    return fit_field_model(known.points_mm, known.centroid_px, start, terms)


def left_out_px(fit: FieldFit, other: Readings) -> Array:
    """Return what a fit leaves at points that it never saw, shape (N,) [px]."""
    rest: Array = other.centroid_px - fit.model.readings_px(other.points_mm)
    return rest


def work_out() -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables of the skew effect, and what they show."""
    field, device = _field_table(), _device_table()
    return (field, device, _axis_table(), _index_table()), (
        (
            "A ray with y/z = v meets a stronger lens: in the plane of the power its index is N = "
            "sqrt(n^2 + (n^2 - 1) v^2 / (1 + u^2)). The traced rays follow it to rounding, so that "
            "distortion depends on both field angles, and no polynomial in u takes it away."
        ),
        (
            "With terms in both field angles what is left is below any line's noise, with a stop. "
            "Without one the outer rays are lost at the lens's edges and by total reflection, more "
            "of them the farther out a point is, and a polynomial does not follow the centroid."
        ),
        (
            "The design's 3.1, 1.5 and 0.002 px are the slit of 4 mm on the plane face, over the "
            "whole field. The first two depend on how the field is sampled (a grid that has the "
            "corners: more; points anywhere: less). The third holds for terms to order 5 only "
            "where v is measured to the row of pixels, v = y / (z + row's distance): the light "
            "that is read goes there. With v = y/z it holds at one distance, and over 1 to 2 m it "
            "is ten times larger."
        ),
        (
            "A stop where the light leaves the lens, on its curved face, has a sixth of the "
            "distortion of one on its plane face: a ray through the middle of the curved face "
            "leaves the lens as it came, whatever the index; only the glass before it, a plate, "
            "shifts the ray."
        ),
        (
            "Terms that no fit can tell from the camera's own parameters, and which are left out: "
            "u^2 (pan), u v (tilt), v (roll), u (principal distance)."
        ),
    )


STOPS: Final[tuple[tuple[str, float, StopPlace], ...]] = (
    ("4 mm, plane face", 4.0, "on the plane face"),
    ("4 mm, 8 mm before", 4.0, "8 mm in front"),
    ("4 mm, curved face", 4.0, "on the curved face"),
    ("none, 19 mm", WIDTH_MM, "on the plane face"),
)
DESIGN_PX: Final = (3.1, 1.5, None, 0.002, None)
"""What the design quotes for the slit of 4 mm, by model."""
_RESULT: Final = (
    "stop", "model", "terms", "design", "RMS", "max", "left out, RMS", "left out, max",
)  # fmt: skip


def _field_table() -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for label, width, place in STOPS:
        assembly = stopped_lens(width, place)
        known = traced_readings(assembly, field_points((15, 9, 4)))
        other = traced_readings(assembly, other_field_points(300))
        for (name, terms), design in zip(MODELS.items(), DESIGN_PX, strict=True):
            fit = fitted(assembly, known, terms)
            figures = (*_figures(fit.residuals_px), *_figures(left_out_px(fit, other)))
            quoted = design if label == STOPS[0][0] else None
            rows.append((label, name, len(terms), quoted, *figures))
    return ResultTable(
        "over the whole field: 2048 px of 12 um, |y/z| to tan 20 deg, 1 to 2 m [px]",
        _RESULT,
        tuple(rows),
    )


def _device_table() -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for label, width, place in STOPS:
        assembly = stopped_lens(width, place)
        sensors = device_sensors(assembly)
        readings = [
            tuple(
                traced_readings(assembly, sensor.in_sensor_frame(points))
                for points in (cube_points(5), other_cube_points(100))
            )
            for sensor in sensors
        ]
        for name, terms in MODELS.items():
            fits = [fitted(assembly, known, terms) for known, _ in readings]
            fit_rest = np.concatenate([fit.residuals_px for fit in fits])
            other_rest = np.concatenate(
                [left_out_px(fit, other) for fit, (_, other) in zip(fits, readings, strict=True)]
            )
            figures = (*_figures(fit_rest), *_figures(other_rest))
            rows.append((label, name, len(terms), *figures))
    return ResultTable(
        "over the 500 mm cube at 1500 mm before the four sensors of Figure 5.2 [px]",
        tuple(heading for heading in _RESULT if heading != "design"),
        tuple(rows),
    )


def _axis_table() -> ResultTable:
    """Compare v measured to the lens's middle and to the row, at one distance and over 1 to 2 m."""
    assembly = stopped_lens(4.0)
    rows: list[tuple[Cell, ...]] = []
    for label, near_mm in (("1490 to 1500 mm", 1490.0), ("1 to 2 m", None)):
        points = field_points((15, 9, 4))
        if near_mm is not None:
            # The same field angles; two distances at least, or the camera's place is open.
            z = np.linspace(near_mm, 1500.0, 4)[np.arange(len(points)) % 4]
            points = points * (z / points[:, 2])[:, None]
        known = traced_readings(assembly, points)
        behind = row_behind_mm(assembly)
        for name, distance in (("z", 0.0), ("z + distance of the row", behind)):
            start = FieldModel(behind / ROW.pitch_mm, ROW.middle_px, row_behind_mm=distance)
            fit = fit_field_model(known.points_mm, known.centroid_px, start, all_terms(5))
            rows.append((label, name, *_figures(fit.residuals_px)))
    return ResultTable(
        "where v = y / ... is measured to, terms to order 5, 4 mm on the plane face [px]",
        ("points at", "v = y over", "RMS", "max"),
        tuple(rows),
    )


def _index_table() -> ResultTable:
    """Trace skew rays, and rays in the plane through the stronger lens that stands for them."""
    stack = stopped_lens(WIDTH_MM).stack()
    rows: list[tuple[Cell, ...]] = []
    for degrees in (0.0, 5.0, 10.0, 15.0, 20.0):
        v = float(np.tan(np.radians(degrees)))
        u = np.linspace(-0.3, 0.3, 7)
        skew = np.stack([u, np.full_like(u, v), np.ones_like(u)], axis=1)
        differences = []
        for direction in skew:
            origin = np.array([[1.0, 0.0, 0.0]]) - 100.0 * direction
            k = float(direction[1] / np.linalg.norm(direction))
            full = trace_rays(stack, origin, direction[None])
            plane = trace_rays(
                in_plane_stack(stack, k), origin * [1, 0, 1], direction[None] * [1, 0, 1]
            )
            differences.append(full.position_mm[0, 0] - plane.position_mm[0, 0])
        index = float(effective_index(INDEX, np.zeros(1), np.array([v]))[0])
        rows.append(
            (degrees, index, RADIUS_MM / (index - 1.0), float(np.abs(differences).max()) * 1e3)
        )
    return ResultTable(
        "the lens that rays meet which come in at an angle to the x-z plane, at u = 0",
        ("angle [deg]", "index N", "focal length [mm]", "traced less in-plane, max [um]"),
        tuple(rows),
    )


def _figures(residuals_px: Array) -> tuple[float, float]:
    return float(np.sqrt(np.mean(residuals_px**2))), float(np.abs(residuals_px).max())


def _in_space(u: Array, v: Array, z: Array) -> Array:
    return np.stack([u * z, v * z, z], axis=1)


CASE: Final = TablesCase(
    "skew-effect",
    "distortion over both field angles: what models of it leave",
    "sections 3.3, 3.4 and 5.2, Appendices E and F; figures of the design",
    work_out,
)
