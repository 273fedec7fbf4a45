"""Calibrate a device from control points: sensor models with a joint covariance, assessed."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment.cross_validation import cross_validate
from compute.calibration.assessment.diagnosis import diagnose
from compute.calibration.assessment_result import DistortionSelection
from compute.calibration.bundle_adjustment.control_point_adjustment import projected_point_sigma
from compute.calibration.distortion_selection import select_terms
from compute.calibration.mislabels.detector import find_label_errors
from compute.calibration.mislabels.finding import LabelFinding
from compute.calibration.mislabels.repair import exclude, repair
from compute.calibration.result import Calibration, effective_readings
from compute.calibration.result_assembly import (
    assemble_with_exact_points,
    assemble_with_uncertain_points,
)
from compute.calibration.settings import DEFAULTS, CalibrationSettings
from compute.calibration.single_sensor.camera_fit import LensOffsets
from compute.calibration.single_sensor.distortion_terms import preset_terms
from compute.calibration.single_sensor.sensor_fits import (
    ControlObservations,
    SensorFits,
    fit_distorted,
    fit_undistorted,
)
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.observation_checks import check_control_points
from compute.errors import DegeneratePoints, NoConvergence
from compute.progress import Progress

Array = NDArray[np.float64]


MAX_LEAVE_ONE_OUT_POINTS: Final = 100
"""Largest number of control points that are left out one by one; more only block by block."""


def calibrate_and_assess(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    settings: CalibrationSettings = DEFAULTS,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate, cross-validate and diagnose.

    The result is that of ``calibrate`` with ``cross_validation`` (by points where these are few,
    then by blocks of space) and ``diagnosis``.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sensors: the device's S sensors.
        sigma_px: standard deviations of the readings, shape (N, S) [px], or None.
        settings: distortion, the control points' uncertainty, loss, labels.
        progress: called with the fraction done and the stage.

    Raises:
        LumilineError: those of ``calibrate``.
    """
    found = calibrate(
        points_mm,
        readings_px,
        sensors,
        sigma_px,
        settings,
        progress=_partial_progress(progress, 0.0, 0.5),
    )
    observations = points_mm, readings_px, sensors, sigma_px
    checks = []
    if len(points_mm) <= MAX_LEAVE_ONE_OUT_POINTS:
        by_points = _partial_progress(progress, 0.5, 0.75)
        checks.append(cross_validate(found, *observations, "points", by_points))
    by_blocks = _partial_progress(progress, 0.75, 0.9)
    checks.append(cross_validate(found, *observations, "blocks", by_blocks))
    used, _ = effective_readings(found, readings_px)
    diagnosis = diagnose(found, points_mm, used, _partial_progress(progress, 0.9, 1.0))
    return replace(found, cross_validation=tuple(checks), diagnosis=diagnosis)


def calibrate(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    settings: CalibrationSettings = DEFAULTS,
    initial_models: Sequence[SensorModel] | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate S sensors from N control points.

    Stages: a normalised linear solution and a grid of others, the seven metric parameters, the
    distortion, and, where the control points have an uncertainty of their own, a joint adjustment
    of all sensors and points. No starting values are needed; random numbers (the start of a
    robust loss) come from a fixed seed, so that results repeat.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sensors: the device's sensors in order; with their pitches where distortion is fitted, as
            far as they are known.
        sigma_px: standard deviations of the readings, shape (N, S) [px]. None: one for each
            sensor, estimated from its residuals.
        settings: distortion, the control points' uncertainty, loss, labels.
        initial_models: cameras from which the search starts too, one a sensor; their distortion
            is ignored. None: no others.
        progress: called with the fraction done and the stage.

    Raises:
        TooFewPoints, DegeneratePoints, UndeterminedParameters: the points leave parameters open.
        NonFiniteValue, DuplicatePoint, ReadingOutsideSensor, InvalidParameter: a value is wrong.
        NoConvergence: no camera was found.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings = np.asarray(readings_px, dtype=np.float64)
    sigma = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    check_control_points(points, readings, sensors, sigma)
    labels = None
    if settings.labels != "off":
        search = _partial_progress(progress, 0.0, 0.05)
        labels = find_label_errors(points, readings, sensors, sigma, search).findings
        if labels and settings.labels != "report":
            correct = exclude if settings.labels == "exclude" else repair
            readings, sigma = correct(labels, sensors, readings, sigma)
            check_control_points(points, readings, sensors, sigma)
    seen = np.isfinite(readings)
    observed = ControlObservations(
        points,
        readings,
        np.where(seen, 1.0 if sigma is None else sigma, 1.0),
        sigma is not None,
        tuple(sensors),
    )
    try:
        result = _fit(observed, settings, initial_models, progress)
    except (DegeneratePoints, NoConvergence) as error:
        if not labels:
            raise
        # Report the label errors too: they may be why the fit failed.
        named = "; ".join(_describe(finding) for finding in labels)
        advice = "" if settings.labels != "report" else '; set labels to "repair" or "exclude"'
        raise type(error)(
            f"{error.detail}; labels that look wrong: {named}{advice}", **error.context
        ) from error
    return replace(result, labels=labels or ())


def _describe(finding: LabelFinding) -> str:
    sensor = "all sensors" if finding.sensor is None else f"sensor {finding.sensor}"
    points = " and ".join(str(point) for point in finding.points)
    return f"{finding.kind} for {sensor}: {points} (probability {finding.probability:.2g})"


def _fit(
    observed: ControlObservations,
    settings: CalibrationSettings,
    initial_models: Sequence[SensorModel] | None,
    progress: Progress | None,
) -> Calibration:
    _report_progress(progress, 0.05, "cameras without distortion")
    models, weights = fit_undistorted(observed, settings.loss, initial_models)
    weighted = _with_point_sigma(observed, models, settings.control_sigma_mm)
    fits, selection = _fit_distortion(weighted, models, weights, settings, progress)
    _report_progress(progress, 0.8, "covariance")
    if settings.control_sigma_mm is None:
        result = assemble_with_exact_points(observed, fits, settings)
    else:
        joint = _partial_progress(progress, 0.8, 1.0)
        result = assemble_with_uncertain_points(
            observed, fits, settings, settings.control_sigma_mm, joint
        )
    _report_progress(progress, 1.0, "calibrated")
    return replace(result, distortion=selection)


def _with_point_sigma(
    observed: ControlObservations, models: tuple[SensorModel, ...], control_sigma_mm: float | None
) -> ControlObservations:
    """Add the control points' uncertainty to the readings' standard deviations."""
    if control_sigma_mm is None or not observed.sigma_known:
        return observed
    point_sigma = np.nan_to_num(projected_point_sigma(models, observed.points_mm, control_sigma_mm))
    return replace(observed, sigma_px=np.hypot(observed.sigma_px, point_sigma))


def _fit_distortion(
    observed: ControlObservations,
    models: tuple[SensorModel, ...],
    weights: Array,
    settings: CalibrationSettings,
    progress: Progress | None,
) -> tuple[SensorFits, DistortionSelection | None]:
    requested = settings.distortion
    lens_offsets = LensOffsets.of(models, observed.pitch_um, observed.points_mm, observed.seen)
    if requested == "none":
        return SensorFits(models, weights, lens_offsets), None
    if requested == "auto":
        terms, selection = select_terms(
            observed,
            models,
            weights,
            lens_offsets,
            settings.loss,
            _partial_progress(progress, 0.1, 0.7),
        )
    else:
        named = isinstance(requested, str)
        sensor_terms = preset_terms(requested) if isinstance(requested, str) else requested
        terms = (sensor_terms,) * len(models)
        selection = DistortionSelection(str(requested) if named else "terms", "as asked")
    _report_progress(progress, 0.7, f"distortion {selection.chosen}")
    return fit_distorted(observed, models, terms, lens_offsets, settings.loss, weights), selection


def _report_progress(progress: Progress | None, fraction: float, stage: str) -> None:
    if progress is not None:
        progress(fraction, stage)


def _partial_progress(progress: Progress | None, first: float, last: float) -> Progress | None:
    """Return the callback of a part of a computation, from one fraction of the whole to another."""
    if progress is None:
        return None
    return lambda fraction, stage: progress(first + (last - first) * fraction, stage)
