"""Calibrate a device: every sensor's model from control points, with a joint covariance."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import DistortionSelection
from compute.calibration.bundle_adjustment.control_point_adjustment import projected_point_sigma
from compute.calibration.control_data_checks import check_observations
from compute.calibration.distortion_selection import select_terms
from compute.calibration.mislabels.detector import find_label_errors
from compute.calibration.mislabels.finding import LabelFinding
from compute.calibration.mislabels.repair import exclude, repair
from compute.calibration.result import Calibration
from compute.calibration.result_assembly import (
    assemble_with_exact_points,
    assemble_with_uncertain_points,
)
from compute.calibration.settings import DEFAULTS, CalibrationSettings
from compute.calibration.single_sensor.distortion_fit import LensOffsets
from compute.calibration.single_sensor.distortion_terms import preset_terms
from compute.calibration.single_sensor.sensor_fits import (
    ControlObservations,
    SensorFits,
    fit_distorted,
    fit_undistorted,
)
from compute.calibration.thesis_methods.thesis_methods import fit_thesis_method
from compute.camera.model import SensorGeometry, SensorModel
from compute.errors import DegeneratePoints, NoConvergence

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]


def calibrate(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    settings: CalibrationSettings = DEFAULTS,
    near: Sequence[SensorModel] | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate S sensors from N control points.

    "metric" goes by stages: a normalised linear solution and a grid of others, the seven metric
    parameters, the distortion, and, where the control points have an uncertainty of their own,
    all sensors and points together. It needs no starting values and draws no random numbers
    but those of a fixed seed (a robust loss's start).
    "dlt-iterative" is the thesis's [5.1]-[5.12] as published, for comparison; its covariance is
    that of a metric camera with its residuals and leaves out D. "bundle-11" is its [5.21]-[5.29].

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sensors: the device's sensors in order; with their pitches where distortion is fitted, as
            far as they are known.
        sigma_px: standard deviations of the readings, shape (N, S) [px]. None: one deviation
            for each sensor, estimated from its residuals.
        settings: method, distortion, the points' own deviation, loss, labels.
        near: for "metric", cameras that may be close, where it is searched besides; what they
            have of distortion is left aside.
        progress: called with the fraction done and the stage in words; what it raises passes
            through, which is how a run is cancelled.

    Raises:
        TooFewPoints, DegeneratePoints, NonFiniteValue, DuplicatePoint, ReadingOutsideSensor,
        InvalidParameter, UndeterminedParameters: the observations are not fit for it.
        NoConvergence: no camera was found.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings = np.asarray(readings_px, dtype=np.float64)
    deviations = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    check_observations(points, readings, sensors, deviations)
    labels = None
    if settings.labels != "off":

        def search(fraction: float, stage: str) -> None:
            _report_progress(progress, 0.05 * fraction, stage)

        labels = find_label_errors(points, readings, sensors, deviations, search).findings
        if labels and settings.labels != "report":
            correct = exclude if settings.labels == "exclude" else repair
            readings, deviations = correct(labels, sensors, readings, deviations)
            check_observations(points, readings, sensors, deviations)
    seen = np.isfinite(readings)
    observed = ControlObservations(
        points,
        readings,
        np.where(seen, 1.0 if deviations is None else deviations, 1.0),
        deviations is not None,
        tuple(sensors),
    )
    try:
        result = _fit(observed, settings, near, progress)
    except (DegeneratePoints, NoConvergence) as error:
        if not labels:
            raise
        # What was found must not be lost with the fit that it spoils.
        named = "; ".join(_describe(one) for one in labels)
        advice = "" if settings.labels != "report" else '; "repair" or "exclude" deals with them'
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
    near: Sequence[SensorModel] | None,
    progress: Progress | None,
) -> Calibration:
    if settings.method != "metric":
        return fit_thesis_method(observed, settings, progress)
    _report_progress(progress, 0.05, "cameras without distortion")
    models, weights = fit_undistorted(observed, settings.loss, near)
    staged = _with_point_sigma(observed, models, settings.control_sigma_mm)
    fits, selection = _fit_distortion(staged, models, weights, settings, progress)
    _report_progress(progress, 0.8, "covariance")
    if settings.control_sigma_mm is None:
        result = assemble_with_exact_points(observed, fits, settings)
    else:

        def last(fraction: float, stage: str) -> None:
            _report_progress(progress, 0.8 + 0.2 * fraction, stage)

        result = assemble_with_uncertain_points(
            observed, fits, settings, settings.control_sigma_mm, last
        )
    _report_progress(progress, 1.0, "calibrated")
    return replace(result, distortion=selection)


def _report_progress(progress: Progress | None, fraction: float, stage: str) -> None:
    if progress is not None:
        progress(fraction, stage)


def _with_point_sigma(
    observed: ControlObservations, models: tuple[SensorModel, ...], control_sigma_mm: float | None
) -> ControlObservations:
    """Return the readings with the control points' uncertainty as part of their deviations."""
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
    asked = settings.distortion
    lens_offsets = LensOffsets.of(models, observed.pitch_um, observed.points_mm, observed.seen)
    if asked == "none":
        return SensorFits(models, weights, lens_offsets), None
    if asked == "auto":

        def part(fraction: float, stage: str) -> None:
            _report_progress(progress, 0.1 + 0.6 * fraction, stage)

        terms, selection = select_terms(
            observed, models, weights, lens_offsets, settings.loss, part
        )
    else:
        own = preset_terms(asked) if isinstance(asked, str) else asked
        terms = (own,) * len(models)
        selection = DistortionSelection(asked if isinstance(asked, str) else "terms", "as asked")
    _report_progress(progress, 0.7, f"distortion {selection.chosen}")
    return fit_distorted(observed, models, terms, lens_offsets, settings.loss, weights), selection
