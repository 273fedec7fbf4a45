"""self_calibrate: sensors from readings of a target at unknown poses, and one known length."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import (
    AdjustmentResult,
    undetermined_poses,
)
from compute.calibration.bundle_adjustment.data_snooping import (
    SIGMA_FLOOR_PX,
    sensor_sigma,
    worst_readings,
)
from compute.calibration.bundle_adjustment.solver import adjust
from compute.calibration.self_calibration.coarse_solution import coarse_solution, lens_offset_prior
from compute.calibration.self_calibration.datum import (
    DatumResult,
    align_to_start,
    to_first_pose_frame,
    to_start_frame,
)
from compute.calibration.self_calibration.initial_poses import (
    InitialPoses,
    observed_scale,
    start_poses,
)
from compute.calibration.self_calibration.pose_screening import find_outlier_readings, screen_poses
from compute.calibration.self_calibration.recording_checks import (
    check_count,
    check_observed_scale,
    check_recordings,
    check_scale,
    check_volume_coverage,
    device_scale,
)
from compute.calibration.self_calibration.result import (
    Datum,
    RejectedMeasurement,
    SelfCalibration,
    summarise,
)
from compute.calibration.self_calibration.targets import Recording, RigidBody
from compute.camera.model import SensorModel
from compute.errors import InvalidParameter, NoConvergence
from compute.progress import Progress, no_progress

Array = NDArray[np.float64]

REJECTION_ROUNDS: Final = 20
MIN_SHARE: Final = 0.6
"""Smallest share of the readings that must agree."""
NOISE_ROUNDS: Final = 2
SCREENING_ROUNDS: Final = 3


def self_calibrate(
    models: Sequence[SensorModel],
    recordings: Sequence[Recording],
    *,
    datum: Datum = "start",
    progress: Progress = no_progress,
) -> SelfCalibration:
    """Calibrate S sensors without known coordinates, from approximate cameras.

    The start is the nominal geometry or an earlier calibration; it may be wrong by 20 % in every
    parameter (``lumiline reproduce wand`` gives the success rates). All poses and all sensors are
    adjusted jointly, with a robust loss and rejection of outliers. Distortion terms of the start
    are adjusted, too.

    Args:
        models: the start, one for each sensor of the device.
        recordings: readings of wands, rigid bodies or frames, all with standard deviations or
            all without: then each sensor's comes from its residuals.
        datum: the world frame. "start": where the starting cameras fit the readings best.
            "first-pose": the frame of the rigid body of the first recording at its first pose.
        progress: called with the fraction done and the stage.

    Raises:
        InvalidParameter: readings, lengths or options that contradict each other.
        TooFewPoints, DegeneratePoints, ReadingOutsideSensor: the recordings cannot calibrate.
        UndeterminedParameters: a combination of parameters is undetermined.
        NoConvergence: the start is too wrong, or the readings contradict one another.
    """
    check_recordings(models, recordings)
    sigma_given = {recording.sigma_px is not None for recording in recordings}
    if len(sigma_given) > 1:
        raise InvalidParameter("some recordings have standard deviations and some not; give all")
    if datum == "first-pose" and not isinstance(recordings[0].target, RigidBody):
        raise InvalidParameter(
            'datum is "first-pose", but the first recording is not of a rigid body of known shape'
        )
    progress(0.0, "start")
    work = _SelfCalibrationState(tuple(models), tuple(recordings), sigma_given == {True})
    scales = tuple(observed_scale(models, recording) for recording in recordings)
    for scale in scales:
        check_observed_scale(scale)
    check_count(models, [start.poses for start in work.starts(False)])
    progress(0.1, "search")
    work.models = coarse_solution(models, work.kept_recordings(), work.sigma)
    check_scale(models, work.models)
    progress(0.5, "adjustment")
    check_volume_coverage([start.poses for start in work.starts(True)])
    for _ in range(SCREENING_ROUNDS):
        adjusted = work.adjusted(work.screen_poses())
        if not work.sigma_given:
            work.scale_sigma(sensor_sigma(adjusted, robust=True))
    progress(0.7, "outliers")
    work.reject_single_outliers()
    for _ in range(REJECTION_ROUNDS):
        starts = work.screen_poses()
        adjusted = work.adjusted(starts)
        if not work.reject(adjusted, starts):
            break
    if not work.sigma_given:
        for _ in range(NOISE_ROUNDS):
            work.scale_sigma(sensor_sigma(adjusted, robust=False))
            starts = work.screen_poses()
            adjusted = work.adjusted(starts)
    work.check_share(starts)
    progress(0.95, "world frame")
    placed = _apply_datum(adjusted, models, starts, recordings, datum)
    result = summarise(
        adjusted,
        placed,
        starts,
        recordings,
        datum=datum,
        start_scales=scales,
        device_scale=device_scale(models, placed.models),
        rejected=work.rejected,
        sigma_given=work.sigma_given,
    )
    progress(1.0, "done")
    return result


def _apply_datum(
    adjusted: AdjustmentResult,
    models: Sequence[SensorModel],
    starts: Sequence[InitialPoses],
    recordings: Sequence[Recording],
    datum: Datum,
) -> DatumResult:
    target = recordings[0].target
    if datum == "start" or not isinstance(target, RigidBody):
        return to_start_frame(adjusted, models)
    if starts[0].pose_index[0] != 0:
        raise InvalidParameter(
            'datum is "first-pose", but the first pose shows too little of the body, or '
            "contradicts the others; leave it out, so that another is the first"
        )
    return to_first_pose_frame(adjusted, np.mean(target.marker_mm, axis=0))


@dataclass(eq=False)
class _SelfCalibrationState:
    """State of a run: current cameras, noise, and readings not rejected."""

    models: tuple[SensorModel, ...]
    recordings: tuple[Recording, ...]
    sigma_given: bool

    def __post_init__(self) -> None:
        self.start = self.models
        self.readings = [recording.readings_px.copy() for recording in self.recordings]
        self.sigma = [
            np.ones(one.readings_px.shape) if one.sigma_px is None else one.sigma_px
            for one in self.recordings
        ]
        self.rejected: list[RejectedMeasurement] = []

    def kept_recordings(self) -> list[Recording]:
        """Return the recordings without rejected readings."""
        return [
            Recording(recording.target, readings)
            for recording, readings in zip(self.recordings, self.readings, strict=True)
        ]

    def starts(self, trusted: bool) -> list[InitialPoses]:
        """Fit all poses to the current cameras, without undetermined ones."""
        starts = []
        for recording, sigma in zip(self.kept_recordings(), self.sigma, strict=True):
            start = start_poses(self.models, recording, sigma, trusted=trusted)
            starts.append(start.select(~undetermined_poses(self.models, start.poses)))
        return starts

    def screen_poses(self) -> list[InitialPoses]:
        """Fit all poses to the current cameras, without contradictory ones."""
        return [screen_poses(self.models, start).consistent for start in self.starts(True)]

    def reject_single_outliers(self) -> None:
        """Reject the single outlier of each contradictory pose that has one."""
        for number, start in enumerate(self.starts(True)):
            fitted = screen_poses(self.models, start)
            bad = start.poses.select(~fitted.good)
            if len(bad):
                poses, indices, residuals = find_outlier_readings(self.models, bad)
                pose_index = start.pose_index[~fitted.good][poses]
                self._reject_readings(number, np.column_stack([pose_index, indices]), residuals)

    def adjusted(self, starts: Sequence[InitialPoses]) -> AdjustmentResult:
        """Adjust all sensors and poses, and keep the cameras."""
        pose_sets = [start.poses for start in starts]
        adjusted = adjust(
            self.models, pose_sets, prior=lens_offset_prior(self.start, pose_sets), free_datum=True
        )
        self.models = align_to_start(adjusted.models, self.start)
        return adjusted

    def scale_sigma(self, factors: Array) -> None:
        """Multiply the sensors' standard deviations by factors (S,)."""
        self.sigma = [np.maximum(one * factors, SIGMA_FLOOR_PX) for one in self.sigma]

    def reject(self, adjusted: AdjustmentResult, starts: Sequence[InitialPoses]) -> int:
        """Reject the largest outlier of each pose that has one; return how many."""
        count = 0
        for number, start in enumerate(starts):
            indices, residuals = worst_readings(adjusted, number)
            indices[:, 0] = start.pose_index[indices[:, 0]]
            self._reject_readings(number, indices, residuals)
            count += len(indices)
        return count

    def _reject_readings(self, number: int, indices: NDArray[np.intp], residuals: Array) -> None:
        for (pose, marker, sensor), residual in zip(
            indices.tolist(), residuals.tolist(), strict=True
        ):
            self.readings[number][pose, marker, sensor] = np.nan
            name = self.models[sensor].name
            self.rejected.append(
                RejectedMeasurement(number + 1, pose + 1, marker + 1, name, residual)
            )

    def check_share(self, starts: Sequence[InitialPoses]) -> None:
        """Check that enough of the readings agree with one another.

        Raises:
            NoConvergence: too large a share of them was rejected.
        """
        total = sum(int(np.isfinite(one.readings_px).sum()) for one in self.recordings)
        used = sum(int(start.poses.seen.sum()) for start in starts)
        if used < MIN_SHARE * total:
            raise NoConvergence(
                f"only {used} of {total} readings agree with one another; the start is too "
                "wrong, the lengths do not belong to what was moved, or the standard deviations "
                "are far too small",
                used=used,
            )
