"""SelfCalibration: result of a self-calibration with its targets and rejected readings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import Diagnosis
from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.result import Calibration, SensorFit, nested_rows
from compute.calibration.self_calibration.datum import DatumResult
from compute.calibration.self_calibration.initial_poses import (
    InitialPoses,
    marker_distances,
    triangulate,
)
from compute.calibration.self_calibration.targets import Recording
from compute.camera.model import SensorModel, Vector3, vector3
from compute.camera.observation_checks import UNEXPLAINED_PROBABILITY
from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]
Datum = Literal["start", "first-pose"]


@dataclass(frozen=True)
class RejectedMeasurement:
    """A reading that was rejected as an outlier.

    Args:
        recording: counted from 1.
        pose: counted from 1.
        marker: counted from 1.
        sensor: its name.
        normalised_residual: its residual over its own standard deviation when rejected.
    """

    recording: int
    pose: int
    marker: int
    sensor: str
    normalised_residual: float


@dataclass(frozen=True)
class ExchangedReadings:
    """Readings of two markers that one sensor had exchanged; they were exchanged back.

    Args:
        recording: counted from 1.
        pose: counted from 1.
        first: a marker, counted from 1.
        second: the other.
        sensor: its name.
    """

    recording: int
    pose: int
    first: int
    second: int
    sensor: str


@dataclass(frozen=True)
class TargetFit:
    """Fit of one recording's target.

    Args:
        poses: number of poses in the recording.
        used: number of poses used; the others showed too little or contradicted the rest.
        markers_mm: the adjusted shape, about its centroid (a wand's along x), shape (K, 3) [mm].
        start_scale: median of lengths as the starting cameras see them over the known ones.
        length_error_mm: RMS of the target's lengths between reconstructed markers minus those of
            the adjusted shape [mm]; None without any.
    """

    poses: int
    used: int
    markers_mm: tuple[Vector3, ...]
    start_scale: float
    length_error_mm: float | None


@dataclass(frozen=True)
class SelfCalibration:
    """A calibration without known coordinates.

    Args:
        calibration: sensors, joint covariance in the chosen frame, and residuals; a row for each
            marker of each pose of each recording, in this order.
        datum: which frame is the world's.
        device_scale: size of the device, from the known lengths, over that of the start: far from 1
            where either is wrong; None without a start.
        targets: one for each recording.
        rejected: readings that were rejected.
        chi2_per_dof: weighted sum of squares per degree of freedom of the readings used.
        dof: number of readings minus unknowns.
        exchanged: readings that were exchanged between two markers.
        warnings: what the user must know, in sentences.
    """

    calibration: Calibration
    datum: Datum
    device_scale: float | None
    targets: tuple[TargetFit, ...]
    rejected: tuple[RejectedMeasurement, ...]
    chi2_per_dof: float
    dof: int
    exchanged: tuple[ExchangedReadings, ...] = ()
    warnings: tuple[str, ...] = ()


def summarise(
    adjusted: AdjustmentResult,
    placed: DatumResult,
    starts: Sequence[InitialPoses],
    recordings: Sequence[Recording],
    *,
    datum: Datum,
    start_scales: Sequence[float],
    device_scale: float | None,
    rejected: Sequence[RejectedMeasurement],
    exchanged: Sequence[ExchangedReadings],
    warnings: Sequence[str],
    sigma_given: bool,
) -> SelfCalibration:
    """Summarise a run as a SelfCalibration.

    Residuals that the given standard deviations do not explain inflate the covariance, as in
    ``calibrate``; with estimated ones the uncertainty of the estimate is included.

    Args:
        adjusted: the adjustment.
        placed: the same in the world frame.
        starts: the poses that were used.
        recordings: the readings.
        datum: which frame is the world's.
        start_scales: lengths seen by the start over the known ones, for each recording.
        device_scale: size of the solved device over that of the start; None without one.
        rejected: readings that were rejected.
        exchanged: readings that were exchanged.
        warnings: in sentences.
        sigma_given: whether the readings came with standard deviations.
    """
    dof = adjusted.dof
    chi2_per_dof = adjusted.chi2 / dof if dof > 0 else float("nan")
    factor = 1.0
    if sigma_given and dof > 0 and adjusted.chi2 > chi2_limit(dof, UNEXPLAINED_PROBABILITY):
        factor = chi2_per_dof
    elif not sigma_given and dof > 2:
        factor = dof / (dof - 2)
    residuals = _in_pixels(adjusted, starts, recordings)
    of_sensor = np.concatenate([np.nonzero(start.poses.observed_mask)[2] for start in starts])
    sigma = np.concatenate([start.poses.sigma_px[start.poses.observed_mask] for start in starts])
    fits = tuple(
        SensorFit(
            model,
            int(np.isfinite(residuals[:, column]).sum()),
            float(np.sqrt(np.nanmean(residuals[:, column] ** 2))),
            float(np.nanmax(np.abs(residuals[:, column]))),
            float(np.sqrt(np.mean(sigma[of_sensor == column] ** 2))),
            "given" if sigma_given else "residuals",
            chi2_per_dof if sigma_given else None,
        )
        for column, model in enumerate(placed.models)
    )
    calibration = Calibration(
        "self-calibration",
        fits,
        tuple(tuple(row) for row in (placed.covariance * factor).tolist()),
        nested_rows(residuals),
        diagnosis=Diagnosis((), None, None, (), tuple(warnings)) if warnings else None,
    )
    targets = tuple(
        TargetFit(
            len(recording.readings_px),
            len(poses),
            tuple(vector3(row) for row in poses.shape.marker_mm),
            scale,
            _length_error(placed.models, poses),
        )
        for poses, scale, recording in zip(placed.pose_sets, start_scales, recordings, strict=True)
    )
    return SelfCalibration(
        calibration,
        datum,
        device_scale,
        targets,
        tuple(rejected),
        chi2_per_dof,
        dof,
        tuple(exchanged),
        tuple(warnings),
    )


def _in_pixels(
    adjusted: AdjustmentResult, starts: Sequence[InitialPoses], recordings: Sequence[Recording]
) -> Array:
    """Return fitted minus read [px], a row for each marker of each pose, NaN where not used."""
    rows = []
    for residual, start, recording in zip(adjusted.residuals, starts, recordings, strict=True):
        full = np.full(recording.readings_px.shape, np.nan)
        full[start.pose_index] = residual * start.poses.sigma_px
        rows.append(full.reshape(-1, len(adjusted.models)))
    return np.concatenate(rows)


def _length_error(models: Sequence[SensorModel], poses: PoseSet) -> float | None:
    measured = marker_distances(triangulate(CameraStack.of(models), poses.readings_px))
    error = (measured - marker_distances(poses.shape.marker_mm))[np.isfinite(measured)]
    return float(np.sqrt(np.mean(error**2))) if len(error) else None
