"""Contributions to a point's uncertainty, source by source, at every point of a plan.

All are standard uncertainties along X, Y and Z. Errors of readings become errors of points by the
gain K = d point / d reading of the weighted solution.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry
from compute.camera.stack import CameraStack
from compute.measurement.measurement_model import MeasurementModel
from compute.planning.budget_inputs import BudgetInputs
from compute.planning.coverage import Box, is_visible
from compute.planning.planning_device import PlanningDevice
from compute.planning.precision import propagated_sigma, reading_gain
from compute.planning.simulated_readings import SimulatedReadings

Array = NDArray[np.float64]
Kind = Literal["random", "systematic"]

_STEP_SIGMA: Final = 12.0**-0.5
"""Standard uncertainty of a rounding to steps of 1 (rectangular distribution)."""

_TERMS: Final = "symmetric-5"
"""Terms of the distortion that the planned calibration fits."""

_LIGHT: Final = ("optics", "detector", "markers", "rates")


@dataclass(frozen=True, eq=False)
class ErrorContribution:
    """One source's share of the uncertainty of N points.

    Args:
        name: what it is.
        kind: "random": another value in each exposure; "systematic": the same as long as marker
            and device stay as they are.
        counted: it is part of the total; otherwise what would be with another correction.
        inputs: fields of ``ErrorSources`` and other sections of the profile that it depends on.
        sigma_mm: standard uncertainties, shape (N, 3) [mm]; NaN where there is no position.
    """

    name: str
    kind: Kind
    counted: bool
    inputs: tuple[str, ...]
    sigma_mm: Array


@dataclass(frozen=True, eq=False)
class PlannedScene:
    """Inputs of the error budget: device, points, their readings and the error sources.

    Args:
        device: the sensors.
        lines: their readings of the N points.
        box: the volume.
        points_mm: shape (N, 3) [mm].
        distortion_mm: errors that perspective cameras make, shape (N, 3) [mm].
        marker_radius_mm: of a retro-reflective marker, a flat disc [mm]; None: the markers are
            LEDs.
        inputs: the error sources.
    """

    device: PlanningDevice
    lines: SimulatedReadings
    box: Box
    points_mm: Array
    distortion_mm: Array
    marker_radius_mm: float | None
    inputs: BudgetInputs


def error_contributions(scene: PlannedScene) -> tuple[ErrorContribution, ...]:
    """Return the contributions of all sources, in a fixed order.

    Args:
        scene: the planned device, its volume and its error sources.

    Raises:
        TooFewPoints, UndeterminedParameters, DegeneratePoints, NoConvergence: the control points
            do not calibrate the sensors.
    """
    gain = reading_gain(scene.lines.gradient_px_per_mm, scene.lines.bound_px)
    return (
        *_reading_errors(scene, gain),
        _calibration(scene, gain),
        *_distortion(scene, gain),
        _marker(scene, gain),
        *_temperature(scene, gain),
        _timing(scene, gain),
    )


def _reading_errors(scene: PlannedScene, gain: Array) -> Iterator[ErrorContribution]:
    """Yield noise, rounding, and the fixed pattern as it is and after a flat field."""
    lines, inputs = scene.lines, scene.inputs
    yield ErrorContribution("noise", "random", True, _LIGHT, propagated_sigma(gain, lines.bound_px))
    step = np.full(lines.bound_px.shape, inputs.number("reading_step_px") * _STEP_SIGMA)
    yield ErrorContribution(
        "rounding of readings", "random", True, ("reading_step_px",), propagated_sigma(gain, step)
    )
    # Readings that are numbers from the start have no pixels.
    pattern_px = np.zeros_like(lines.bound_px) if _is_gray(scene) else lines.pattern_px
    pattern = propagated_sigma(gain, pattern_px)
    flat = inputs.choice("pixels") == "flat-fielded"
    yield ErrorContribution("fixed pattern", "systematic", not flat, ("pixels", *_LIGHT), pattern)
    residual = inputs.number("flat_field_residual")
    names = ("pixels", "flat_field_residual", *_LIGHT)
    yield ErrorContribution(
        "fixed pattern, flat-fielded", "systematic", flat, names, residual * pattern
    )


def _is_gray(scene: PlannedScene) -> bool:
    return scene.device.quantisation_px is not None


def _control_points(scene: PlannedScene) -> Array:
    """Return the control points of the calibration, evenly over the box, shape (M, 3) [mm]."""
    count = round(scene.inputs.number("control_points"))
    # Halton's sequence is the same in every plan; its first point is a corner.
    share = qmc.Halton(3, scramble=False).random(count + 1)[1:] - 0.5
    points: Array = np.asarray(scene.box.centre_mm) + share * np.asarray(scene.box.size_mm)
    return points


def _calibrate(
    scene: PlannedScene, points_mm: Array, readings_px: Array, settings: CalibrationSettings
) -> Calibration:
    """Calibrate from exact readings with the uncertainties that the budget states.

    Args:
        scene: the planned device.
        points_mm: control points, shape (M, 3) [mm].
        readings_px: shape (M, S) [px]; NaN where there is none.
        settings: terms, and the control points' uncertainty.
    """
    device = scene.device
    step = scene.inputs.number("reading_step_px") * _STEP_SIGMA
    sigma = np.hypot(np.nanmedian(scene.lines.bound_px, axis=0), step)
    return calibrate(
        points_mm,
        readings_px,
        [SensorGeometry(name, device.pixels) for name in device.names],
        np.broadcast_to(sigma, readings_px.shape).copy(),
        settings,
    )


def _calibration(scene: PlannedScene, gain: Array) -> ErrorContribution:
    """Return the share of the cameras' covariance by control points spread over the volume.

    The covariance is that of a calibration of exact perspective readings with the stated
    uncertainties: the readings' noise and rounding, the control points' coordinates, and, where
    distortion is corrected, the terms besides seven parameters.
    """
    inputs = scene.inputs
    points = _control_points(scene)
    readings = scene.lines.cameras.project(points)
    on_pixels = is_visible(readings, scene.device.pixels, np.ones_like(readings))
    sigma = inputs.number("control_position_sigma_mm")
    settings = CalibrationSettings(
        "none" if inputs.choice("distortion") == "uncorrected" else _TERMS,
        position_sigma_mm=sigma if sigma > 0.0 else None,
    )
    calibration = _calibrate(scene, points, np.where(on_pixels, readings, np.nan), settings)
    model = MeasurementModel.of(calibration.models, np.array(calibration.covariance))
    covariance = model.systematic_covariance(scene.points_mm)
    variance = np.einsum("nis,nst,nit->ni", gain, covariance, gain)
    names = ("control_points", "control_position_sigma_mm", "distortion", "reading_step_px")
    return ErrorContribution("calibration", "systematic", True, names, np.sqrt(variance))


def _distortion(scene: PlannedScene, gain: Array) -> Iterator[ErrorContribution]:
    """Yield the errors by distortion: uncorrected, after terms, after a table."""
    inputs = scene.inputs
    state = inputs.choice("distortion")
    stated = inputs.by_field.get("uncorrected_distortion_px")
    uncorrected = np.abs(scene.distortion_mm)
    if stated is not None:
        assert isinstance(stated.value, tuple)
        uncorrected = propagated_sigma(gain, np.array(stated.value))
    names: tuple[str, ...]
    names = ("distortion", "optics" if stated is None else "uncorrected_distortion_px")
    yield ErrorContribution(
        "distortion, uncorrected", "systematic", state == "uncorrected", names, uncorrected
    )
    by_terms = np.hypot(
        _common(gain, _terms_misfit(scene)),
        propagated_sigma(gain, _alike(scene, "terms_residual_px")),
    )
    names = ("distortion", "terms_residual_px", "control_points", "optics")
    yield ErrorContribution(
        "distortion after terms", "systematic", state == "terms", names, by_terms
    )
    by_map = propagated_sigma(gain, _alike(scene, "map_residual_px"))
    names = ("distortion", "map_residual_px")
    yield ErrorContribution("distortion after a map", "systematic", state == "map", names, by_map)


def _alike(scene: PlannedScene, field: str) -> Array:
    """Return an input as an error of each sensor's readings, shape (S,)."""
    return np.full(len(scene.device.names), scene.inputs.number(field))


def _terms_misfit(scene: PlannedScene) -> Array:
    """Return what terms fitted at the control points leave of the traced lens, (N, S) [px]."""
    points, device = _control_points(scene), scene.device
    image = device.image_points(points)
    visible = is_visible(image.readings_px, device.pixels, image.light_sr)
    readings = np.where(visible, image.readings_px, np.nan)
    calibration = _calibrate(scene, points, readings, CalibrationSettings(_TERMS))
    misfit = CameraStack.of(calibration.models).project(scene.points_mm) - scene.lines.readings_px
    return np.nan_to_num(misfit)


def _marker(scene: PlannedScene, gain: Array) -> ErrorContribution:
    """Return the shift of a marker's optical centre with its tilt.

    A centre that lies a depth k behind the assumed one, on an axis tilted by t to the line of
    sight, moves by k sin t across it, in any direction, and by k (1 - cos t) along it. The image
    centre of a tilted disc of radius r at a distance R is, in addition, r^2 sin t cos t / R off
    the image of its centre (perspective eccentricity: Luhmann, 2014, doi 10.1111/phor.12084).
    """
    inputs = scene.inputs
    depth, tilt = inputs.number("optical_centre_depth_mm"), inputs.number("marker_tilt_rad")
    lines_of_sight = scene.points_mm - scene.device.positions_mm.mean(axis=0)
    distance = np.linalg.norm(lines_of_sight, axis=1, keepdims=True)
    along2 = np.square(lines_of_sight / distance)
    across = np.full_like(distance, depth * np.sin(tilt))
    if scene.marker_radius_mm is not None:
        eccentricity = scene.marker_radius_mm**2 * np.sin(tilt) * np.cos(tilt) / distance
        across = np.hypot(across, eccentricity)
    variance = across**2 / 2.0 * (1.0 - along2) + (depth * (1.0 - np.cos(tilt))) ** 2 * along2
    names = ("optical_centre_depth_mm", "marker_tilt_rad")
    return ErrorContribution(
        "marker", "systematic", True, names, _where_located(np.sqrt(variance), gain)
    )


def _temperature(scene: PlannedScene, gain: Array) -> Iterator[ErrorContribution]:
    """Yield what warming and bending of the bar do; the bar runs along its sensors' main axis.

    A sensor at p that moves by d and turns by w (a vector) reads as if the point had moved by
    -(d + w x (X - p)). Warming moves the sensors apart and stretches the principal distance. A
    difference of temperatures between front and back bends the bar to the curvature
    ``expansion difference / depth``: a sensor at s along it moves by s^2/2, and turns by s, times
    the curvature.
    """
    inputs, lines = scene.inputs, scene.lines
    positions = scene.device.positions_mm
    away = positions - positions.mean(axis=0)
    expansion = inputs.number("expansion_per_k")
    warming = inputs.number("temperature_change_k")
    still = np.zeros_like(away)
    error = _moved_reading(scene, expansion * warming * away, still)
    offset = np.nan_to_num(lines.readings_px - lines.cameras.principal_point_px)
    error += inputs.number("focus_expansion_per_k") * warming * offset
    names = ("expansion_per_k", "focus_expansion_per_k", "temperature_change_k")
    yield ErrorContribution("warming", "systematic", True, names, _common(gain, error))

    bar = np.linalg.svd(away)[2][0]
    depth_axis = np.array([0.0, 0.0, 1.0])
    curvature = expansion * inputs.number("bar_gradient_k") / inputs.number("bar_depth_mm")
    along = away @ bar
    shift = 0.5 * curvature * (along**2)[:, None] * depth_axis
    rotation = curvature * along[:, None] * np.cross(bar, depth_axis)
    names = ("expansion_per_k", "bar_gradient_k", "bar_depth_mm")
    sigma = _common(gain, _moved_reading(scene, shift, rotation))
    yield ErrorContribution("bending of the bar", "systematic", True, names, sigma)


def _moved_reading(scene: PlannedScene, shift_mm: Array, rotation_rad: Array) -> Array:
    """Return the changes of readings of sensors that move and turn, shape (N, S) [px]."""
    lines_of_sight = scene.points_mm[:, None] - scene.device.positions_mm
    displacement = shift_mm + np.cross(
        np.broadcast_to(rotation_rad, lines_of_sight.shape), lines_of_sight
    )
    gradient = np.nan_to_num(scene.lines.gradient_px_per_mm)
    error: Array = -np.einsum("nsi,nsi->ns", gradient, displacement)
    return error


def _common(gain: Array, error_px: Array) -> Array:
    """Return the size of a point's error by readings that err together, shape (N, 3) [mm]."""
    size: Array = np.abs(np.einsum("nis,ns->ni", gain, error_px))
    return size


def _timing(scene: PlannedScene, gain: Array) -> ErrorContribution:
    """Return clock times speed, in any direction."""
    moved = scene.inputs.number("timing_s") * scene.inputs.number("speed_mm_per_s")
    sigma = np.full_like(scene.points_mm, moved / np.sqrt(3.0))
    return ErrorContribution(
        "timing", "random", True, ("timing_s", "speed_mm_per_s"), _where_located(sigma, gain)
    )


def _where_located(sigma_mm: Array, gain: Array) -> Array:
    """Return standard uncertainties, NaN where a point has no position."""
    return np.where(np.isfinite(gain).all(axis=2), sigma_mm, np.nan)
