"""Summary of a self-calibration: statistics of sensors, targets and residuals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.result import Calibration, SensorFit
from compute.calibration.self_calibration.datum import DatumResult
from compute.calibration.self_calibration.initial_poses import InitialPoses, triangulate
from compute.calibration.self_calibration.result import (
    Datum,
    RejectedMeasurement,
    SelfCalibration,
    TargetFit,
)
from compute.calibration.self_calibration.targets import Recording
from compute.camera.model import SensorModel, vector3
from compute.camera.observation_checks import UNEXPLAINED_PROBABILITY
from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RunResult:
    """Solution of a self-calibration before it is summarised.

    Args:
        adjusted: the adjustment.
        placed: the same in the world frame.
        starts: the poses that were used.
        recordings: the readings.
        start_scales: lengths seen by the start over the known ones, for each recording.
        device_scale: size of the solved device over that of the start.
        rejected: readings that were rejected.
        sigma_given: whether the readings came with standard deviations.
    """

    adjusted: AdjustmentResult
    placed: DatumResult
    starts: tuple[InitialPoses, ...]
    recordings: tuple[Recording, ...]
    start_scales: tuple[float, ...]
    device_scale: float
    rejected: tuple[RejectedMeasurement, ...]
    sigma_given: bool


def summarise(found: RunResult, datum: Datum) -> SelfCalibration:
    """Summarise a run as a SelfCalibration.

    Residuals that the given standard deviations do not explain inflate the covariance, as in
    ``calibrate``; with estimated ones the uncertainty of the estimate is included.

    Args:
        found: the run's solution.
        datum: which frame is the world's.
    """
    adjusted, placed, starts = found.adjusted, found.placed, found.starts
    recordings, sigma_given = found.recordings, found.sigma_given
    dof = adjusted.dof
    chi2_per_dof = adjusted.chi2 / dof if dof > 0 else float("nan")
    factor = 1.0
    if sigma_given and dof > 0 and adjusted.chi2 > chi2_limit(dof, UNEXPLAINED_PROBABILITY):
        factor = chi2_per_dof
    elif not sigma_given and dof > 2:
        factor = dof / (dof - 2)
    residuals = _in_pixels(adjusted, starts, recordings)
    sigmas = [start.poses.sigma_px[start.poses.seen] for start in starts]
    sensors = [np.nonzero(start.poses.seen)[2] for start in starts]
    of_sensor = np.concatenate(sensors)
    sigma = np.concatenate(sigmas)
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
        tuple(tuple(None if np.isnan(x) else x for x in row) for row in residuals.tolist()),
    )
    targets = tuple(
        TargetFit(
            len(recording.readings_px),
            len(poses),
            tuple(vector3(row) for row in poses.shape.marker_mm),
            scale,
            _length_error(placed.models, poses),
        )
        for poses, scale, recording in zip(
            placed.pose_sets, found.start_scales, recordings, strict=True
        )
    )
    return SelfCalibration(
        calibration, datum, found.device_scale, targets, found.rejected, chi2_per_dof, dof
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
    marker = triangulate(CameraStack.of(models), poses.readings_px)
    first, second = np.triu_indices(len(poses.shape), 1)
    adjusted_length = np.linalg.norm(
        poses.shape.marker_mm[first] - poses.shape.marker_mm[second], axis=1
    )
    measured_length = np.linalg.norm(marker[:, first] - marker[:, second], axis=2)
    error = (measured_length - adjusted_length)[np.isfinite(measured_length)]
    return float(np.sqrt(np.mean(error**2))) if len(error) else None
