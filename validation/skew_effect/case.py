"""Case skew-effect: residual distortion of a camera, of terms in u, and of terms in u and v."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.field_distortion import Term, all_terms, power_terms
from compute.optics.profiles.profile_loader import load_profile
from compute.optics.tracing.reference_tracer import trace_rays
from compute.planning.coverage import Box, volume_grid
from compute.planning.planning_device import planning_device
from compute.planning.simulated_readings import simulate_readings
from validation.aberrations.thesis_lens import (
    INDEX,
    RADIUS_MM,
    ROW,
    WIDTH_MM,
    StopPlace,
    row_behind_mm,
    stopped_lens,
)
from validation.result_tables import Cell, ResultTable, TablesCase
from validation.skew_effect.field_distortion_fit import FieldModel, fit_field_model
from validation.skew_effect.skew_rays import effective_index, in_plane_stack
from validation.skew_effect.traced_readings import (
    cube_points,
    device_sensors,
    field_points,
    fitted,
    left_out_px,
    other_cube_points,
    other_field_points,
    traced_readings,
)

Array = NDArray[np.float64]

MODELS: Final[dict[str, tuple[Term, ...]]] = {
    "7 parameters": (),
    "u^3 u^5 u^7": power_terms(7, odd_only=True),
    "u^3 to u^7": power_terms(7, odd_only=False),
    "u,v order 5": all_terms(5),
    "u,v order 7": all_terms(7),
}


def bar_bound_px() -> float:
    """Return the Cramer-Rao bound of a line of the profile ``bar`` in its volume's middle [px].

    Its lens is this one, its stop that of 4 mm, 8 mm before; the median of its sensors.
    """
    profile = load_profile("bar")
    box = Box(profile.volume.centre_mm, profile.volume.size_mm)
    positions = volume_grid(box, (3, 3, 3)).points_mm
    readings = simulate_readings(planning_device(profile), positions, lambda _: None)
    centre = int(np.linalg.norm(positions - box.centre_mm, axis=1).argmin())
    return float(np.median(readings.bound_px[centre]))


def compute_tables() -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables of the skew effect, and what they show."""
    field, device = _field_table(), _device_table()
    findings = (
        (
            "A ray with y/z = v meets a stronger lens: in the plane of the power its index is N = "
            "sqrt(n^2 + (n^2 - 1) v^2 / (1 + u^2)). The traced rays follow it to rounding, so that "
            "distortion depends on both field angles, and no polynomial in u takes it away."
        ),
        (
            "With a stop, terms in both field angles to order 5 leave, over the whole field at "
            f"points they were not fitted to, {_left(field, 'plane face')} (plane face), "
            f"{_left(field, '8 mm before')} (8 mm before) and {_left(field, 'curved face')} "
            "(curved face); to order 7 "
            f"{_left(field, '8 mm before', 'u,v order 7')} 8 mm before. The noise does not hide "
            "all of it: a line of the profile bar, with this lens and the stop 8 mm before, can be "
            f"read to {bar_bound_px():.4f} px (Cramer-Rao bound, in the middle of its volume). In "
            f"the cube order 5 leaves {_left(device, '8 mm before')}."
        ),
        (
            "Without a stop polynomials do not follow the centroid: order 5 leaves "
            f"{_left(field, 'no stop')}, order 7 {_left(field, 'no stop', 'u,v order 7')}, in the "
            f"cube {_left(device, 'no stop')} and {_left(device, 'no stop', 'u,v order 7')}. From "
            "u = 0.1 on the outer rays are lost at the lens's edges and by total reflection, more "
            "of them the farther out a point is, and the lines reach over thousands of pixels. "
            "They were traced on a row long enough to hold them; on a real one its end cuts them."
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
    return (field, device, _axis_table(), _index_table()), findings


STOPS: Final[tuple[tuple[str, float, StopPlace], ...]] = (
    ("plane face", 4.0, "on the plane face"),
    ("8 mm before", 4.0, "8 mm in front"),
    ("curved face", 4.0, "on the curved face"),
    ("no stop", WIDTH_MM, "on the plane face"),
)
DESIGN_PX: Final = (3.1, 1.5, None, 0.002, None)
"""What the design quotes for the slit of 4 mm, by model."""
_FIGURES: Final = ("RMS", "max", "RMS new", "max new")
"""Over the points of the fit, and over points that it never saw."""


def _field_table() -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for label, width, position in STOPS:
        assembly = stopped_lens(width, position)
        known = traced_readings(assembly, field_points((15, 9, 4)))
        other = traced_readings(assembly, other_field_points(300))
        for (name, terms), design in zip(MODELS.items(), DESIGN_PX, strict=True):
            fit = fitted(assembly, known, terms)
            figures = (*_figures(fit.residuals_px), *_figures(left_out_px(fit, other)))
            quoted = design if label == STOPS[0][0] else None
            rows.append((label, name, quoted, *figures))
    return ResultTable(
        "over the whole field, slits of 4 mm, |y/z| to tan 20 deg, 1 to 2 m [px]; new: at points "
        "that the fit never saw",
        ("stop", "model", "design", *_FIGURES),
        tuple(rows),
    )


def _device_table() -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for label, width, position in STOPS:
        assembly = stopped_lens(width, position)
        sensors = device_sensors(assembly)
        readings = [
            tuple(
                traced_readings(assembly, sensor.to_sensor_frame(points))
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
            rows.append((label, name, *_figures(fit_rest), *_figures(other_rest)))
    return ResultTable(
        "over the 500 mm cube at 1500 mm before the four sensors of Figure 5.2, slits of 4 mm [px]",
        ("stop", "model", *_FIGURES),
        tuple(rows),
    )


def _left(table: ResultTable, stop: str, model: str = "u,v order 5") -> str:
    """Say what a model leaves at points that the fit never saw."""
    (row,) = (row for row in table.rows if row[:2] == (stop, model))
    return f"{row[-2]:g} px RMS, {row[-1]:g} at most"


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
            start = FieldModel(behind / ROW.pitch_mm, ROW.centre_px, row_behind_mm=distance)
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
    """Return RMS and largest, to three digits but no finer than 0.00001 px."""
    found = np.sqrt(np.mean(residuals_px**2)), np.abs(residuals_px).max()
    rms, largest = (round(float(f"{value:.3g}"), 5) for value in found)
    return rms, largest


CASE: Final = TablesCase(
    "skew-effect",
    "distortion over both field angles: what models of it leave",
    "sections 3.3, 3.4 and 5.2, Appendices E and F; figures of the design",
    compute_tables,
)
