"""SelfCalibration: result of a self-calibration with its targets and rejected readings."""

from dataclasses import dataclass
from typing import Literal

from compute.calibration.result import Calibration
from compute.camera.model import Vector3

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
            where either is wrong.
        targets: one for each recording.
        rejected: readings that were rejected.
        chi2_per_dof: weighted sum of squares per degree of freedom of the readings used.
        dof: number of readings minus unknowns.
    """

    calibration: Calibration
    datum: Datum
    device_scale: float
    targets: tuple[TargetFit, ...]
    rejected: tuple[RejectedMeasurement, ...]
    chi2_per_dof: float
    dof: int
