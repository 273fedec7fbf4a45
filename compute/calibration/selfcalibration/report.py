"""From an adjustment to a SelfCalibration: figures of sensors, subjects and residuals."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.adjustment.poses import PoseSet
from compute.calibration.adjustment.result import Adjusted
from compute.calibration.result import Calibration, SensorFit
from compute.calibration.selfcalibration.frame import Placed
from compute.calibration.selfcalibration.result import (
    Datum,
    RejectedReading,
    SelfCalibration,
    SubjectFit,
)
from compute.calibration.selfcalibration.starts import Start, triangulated
from compute.calibration.selfcalibration.subjects import Recording
from compute.camera.model import SensorModel, vector3
from compute.camera.stack import CameraStack
from compute.reconstruction.points import chi2_limit

Array = NDArray[np.float64]

UNEXPLAINED_PROBABILITY: Final = 0.01
"""Chance that right deviations are taken for too small."""


@dataclass(frozen=True, eq=False)
class Found:
    """What a run has found.

    Args:
        adjusted: the adjustment.
        placed: the same in the world's frame.
        starts: the poses that were used.
        recordings: the readings.
        start_scales: lengths as the start saw them over those given, for each recording.
        device_scale: size of the device as found over that of the start.
        rejected: readings that were left out.
        sigma_given: whether the readings came with standard deviations.
    """

    adjusted: Adjusted
    placed: Placed
    starts: tuple[Start, ...]
    recordings: tuple[Recording, ...]
    start_scales: tuple[float, ...]
    device_scale: float
    rejected: tuple[RejectedReading, ...]
    sigma_given: bool


def summary(found: Found, datum: Datum) -> SelfCalibration:
    """Gather what the run has found.

    Residuals that given deviations do not explain make the covariance grow with them, as in
    ``calibrate``; with estimated ones the estimate's own uncertainty is included.
    """
    adjusted, placed, starts = found.adjusted, found.placed, found.starts
    recordings, sigma_given = found.recordings, found.sigma_given
    freedom = adjusted.degrees_of_freedom
    per_freedom = adjusted.chi2 / freedom if freedom > 0 else float("nan")
    factor = 1.0
    if sigma_given and freedom > 0 and adjusted.chi2 > chi2_limit(freedom, UNEXPLAINED_PROBABILITY):
        factor = per_freedom
    elif not sigma_given and freedom > 2:
        factor = freedom / (freedom - 2)
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
            per_freedom if sigma_given else None,
        )
        for column, model in enumerate(placed.models)
    )
    calibration = Calibration(
        "self-calibration",
        fits,
        tuple(tuple(row) for row in (placed.covariance * factor).tolist()),
        tuple(tuple(None if np.isnan(x) else x for x in row) for row in residuals.tolist()),
    )
    subjects = tuple(
        SubjectFit(
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
        calibration, datum, found.device_scale, subjects, found.rejected, per_freedom, freedom
    )


def _in_pixels(
    adjusted: Adjusted, starts: Sequence[Start], recordings: Sequence[Recording]
) -> Array:
    """Return fitted minus read [px], a row for each marker of each pose given, NaN left out."""
    rows = []
    for residual, start, recording in zip(adjusted.residuals, starts, recordings, strict=True):
        full = np.full(recording.readings_px.shape, np.nan)
        full[start.kept] = residual * start.poses.sigma_px
        rows.append(full.reshape(-1, len(adjusted.models)))
    return np.concatenate(rows)


def _length_error(models: Sequence[SensorModel], poses: PoseSet) -> float | None:
    marker = triangulated(CameraStack.of(models), poses.readings_px)
    first, second = np.triu_indices(len(poses.shape), 1)
    own = np.linalg.norm(poses.shape.marker_mm[first] - poses.shape.marker_mm[second], axis=1)
    seen = np.linalg.norm(marker[:, first] - marker[:, second], axis=2)
    error = (seen - own)[np.isfinite(seen)]
    return float(np.sqrt(np.mean(error**2))) if len(error) else None
