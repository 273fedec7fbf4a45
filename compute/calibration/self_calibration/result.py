"""SelfCalibration: the sensors, and what the readings say of the target and of themselves."""

from dataclasses import dataclass
from typing import Literal

from compute.calibration.result import Calibration
from compute.camera.model import Vector3

Datum = Literal["start", "first-pose"]


@dataclass(frozen=True)
class RejectedMeasurement:
    """A reading that contradicts the others.

    Args:
        recording: counted from 1.
        pose: counted from 1.
        marker: counted from 1.
        sensor: its name.
        normalised_residual: its residual in its own standard deviations when it was taken out.
    """

    recording: int
    pose: int
    marker: int
    sensor: str
    normalised_residual: float


@dataclass(frozen=True)
class TargetFit:
    """What became of one recording.

    Args:
        poses: given.
        used: poses that were used; the others showed too little, or contradicted the rest.
        markers_mm: the target's shape as adjusted, about its centroid (a wand's along x) [mm].
        start_scale: lengths as the start's cameras saw them, over those given (median).
        length_error_mm: RMS of the target's lengths, each marker reconstructed by itself, less
            those of the adjusted shape [mm]; None where none could be had.
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
        datum: whose frame the world's is.
        device_scale: size of the device, by the given lengths, over that of the start: far from 1
            where either is wrong.
        targets: one for each recording.
        rejected: readings that were left out.
        chi2_per_dof: weighted sum of squares per degree of freedom, of what was kept.
        dof: readings less unknowns.
    """

    calibration: Calibration
    datum: Datum
    device_scale: float
    targets: tuple[TargetFit, ...]
    rejected: tuple[RejectedMeasurement, ...]
    chi2_per_dof: float
    dof: int
