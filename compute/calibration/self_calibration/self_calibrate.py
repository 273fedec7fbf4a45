"""self_calibrate: sensors from readings of a target at unknown places, and one length."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.calibration.bundle_adjustment.parameter_covariance import undetermined_poses
from compute.calibration.bundle_adjustment.solver import Progress, adjust
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
    select_poses,
    start_poses,
)
from compute.calibration.self_calibration.noise_estimation import (
    SIGMA_FLOOR_PX,
    sensor_sigma,
    worst_readings,
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
from compute.calibration.self_calibration.result import Datum, RejectedMeasurement, SelfCalibration
from compute.calibration.self_calibration.result_summary import RunResult, summarise
from compute.calibration.self_calibration.targets import Recording, RigidBody
from compute.camera.model import SensorModel
from compute.errors import InvalidParameter, NoConvergence

Array = NDArray[np.float64]

REJECTION_ROUNDS: Final = 20
MIN_SHARE: Final = 0.6
"""Share of the readings that must be used, or nothing tells the right ones."""
NOISE_ROUNDS: Final = 2
SCREENING_ROUNDS: Final = 3


def self_calibrate(
    models: Sequence[SensorModel],
    recordings: Sequence[Recording],
    *,
    datum: Datum = "start",
    progress: Progress | None = None,
) -> SelfCalibration:
    """Calibrate S sensors without known coordinates, from cameras that are near.

    The start is the nominal geometry or an earlier calibration; 20 % wrong in every parameter
    will do (``lumiline reproduce wand`` has the shares of success). All poses and all sensors are
    adjusted together; wrong readings lose their influence and are then left out. Sensors whose
    start has distortion terms get theirs adjusted, too.

    Args:
        models: the start, one for each sensor of the device.
        recordings: readings of wands, rigid bodies or frames, all with standard deviations or
            all without: then each sensor's comes from its residuals.
        datum: the world's frame. "start": where the start's cameras read best what was read.
            "first-pose": the frame of the rigid body of the first recording, where it was first
            seen.
        progress: called with the fraction done and the stage; what it raises passes through.

    Raises:
        InvalidParameter: readings, lengths or options that contradict each other.
        TooFewPoints, DegeneratePoints, ReadingOutsideSensor: the recordings are not fit for it.
        UndeterminedParameters: they leave a combination of parameters open.
        NoConvergence: the start is too wrong, or the readings contradict one another.
    """
    tell = progress or _silent
    check_recordings(models, recordings)
    given = {recording.sigma_px is not None for recording in recordings}
    if len(given) > 1:
        raise InvalidParameter("some recordings have standard deviations and some not; give all")
    if datum == "first-pose" and not isinstance(recordings[0].target, RigidBody):
        raise InvalidParameter(
            'datum is "first-pose", but the first recording is not of a rigid body of known shape'
        )
    tell(0.0, "start")
    work = _SelfCalibrationState(tuple(models), tuple(recordings), given == {True})
    scales = tuple(observed_scale(models, recording) for recording in recordings)
    for scale in scales:
        check_observed_scale(scale)
    check_count(models, [start.poses for start in work.starts(False)])
    tell(0.1, "search")
    work.near = coarse_solution(models, work.kept_recordings(), work.sigma)
    check_scale(models, work.near)
    tell(0.5, "adjustment")
    check_volume_coverage([start.poses for start in work.starts(True)])
    for _ in range(SCREENING_ROUNDS):
        adjusted = work.adjusted(work.screen_poses())
        if not work.sigma_given:
            work.scale_sigma(sensor_sigma(adjusted, robust=True))
    tell(0.7, "wrong readings")
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
    tell(0.95, "frame")
    placed = _apply_datum(adjusted, models, starts, recordings, datum)
    found = RunResult(
        adjusted,
        placed,
        tuple(starts),
        tuple(recordings),
        scales,
        device_scale(models, placed.models),
        tuple(work.rejected),
        work.sigma_given,
    )
    result = summarise(found, datum)
    tell(1.0, "done")
    return result


def _silent(_fraction: float, _stage: str) -> None:
    """Tell nobody."""


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
    """What a run has so far: cameras, deviations, and which readings it still takes."""

    near: tuple[SensorModel, ...]
    recordings: tuple[Recording, ...]
    sigma_given: bool

    def __post_init__(self) -> None:
        self.start = self.near
        self.readings = [recording.readings_px.copy() for recording in self.recordings]
        self.sigma = [
            np.ones(one.readings_px.shape) if one.sigma_px is None else one.sigma_px
            for one in self.recordings
        ]
        self.rejected: list[RejectedMeasurement] = []

    def kept_recordings(self) -> list[Recording]:
        """Return the recordings without what was rejected."""
        return [
            Recording(recording.target, readings)
            for recording, readings in zip(self.recordings, self.readings, strict=True)
        ]

    def starts(self, trusted: bool) -> list[InitialPoses]:
        """Place all poses by the cameras of now; poses that would be open are left out."""
        starts = []
        for recording, sigma in zip(self.kept_recordings(), self.sigma, strict=True):
            start = start_poses(self.near, recording, sigma, trusted=trusted)
            closed = ~undetermined_poses(self.near, start.poses)
            starts.append(InitialPoses(select_poses(start.poses, closed), start.pose_index[closed]))
        return starts

    def screen_poses(self) -> list[InitialPoses]:
        """Place all poses by the cameras of now, without those that contradict themselves."""
        starts = []
        for start in self.starts(True):
            fitted = screen_poses(self.near, start)
            starts.append(
                InitialPoses(
                    select_poses(fitted.start.poses, fitted.good), start.pose_index[fitted.good]
                )
            )
        return starts

    def reject_single_outliers(self) -> None:
        """Leave out the one reading that makes its pose contradict itself, where there is one."""
        for number, start in enumerate(self.starts(True)):
            fitted = screen_poses(self.near, start)
            bad = select_poses(start.poses, ~fitted.good)
            if len(bad):
                poses, places, off = find_outlier_readings(self.near, bad)
                own = start.pose_index[~fitted.good][poses]
                self._leave_out(number, np.column_stack([own, places]), off)

    def adjusted(self, starts: Sequence[InitialPoses]) -> AdjustmentResult:
        """Adjust everything from there, and keep the cameras."""
        pose_sets = [start.poses for start in starts]
        adjusted = adjust(
            self.near, pose_sets, prior=lens_offset_prior(self.start, pose_sets), free_datum=True
        )
        self.near = align_to_start(adjusted.models, self.start)
        return adjusted

    def scale_sigma(self, factors: Array) -> None:
        """Take other deviations of the sensors."""
        self.sigma = [np.maximum(one * factors, SIGMA_FLOOR_PX) for one in self.sigma]

    def reject(self, adjusted: AdjustmentResult, starts: Sequence[InitialPoses]) -> int:
        """Leave out the worst reading of each pose that holds a wrong one; return how many."""
        count = 0
        for number, start in enumerate(starts):
            places, off = worst_readings(adjusted, number)
            places[:, 0] = start.pose_index[places[:, 0]]
            self._leave_out(number, places, off)
            count += len(places)
        return count

    def _leave_out(self, number: int, places: NDArray[np.intp], off: Array) -> None:
        for (pose, marker, sensor), size in zip(places.tolist(), off.tolist(), strict=True):
            self.readings[number][pose, marker, sensor] = np.nan
            name = self.near[sensor].name
            self.rejected.append(RejectedMeasurement(number + 1, pose + 1, marker + 1, name, size))

    def check_share(self, starts: Sequence[InitialPoses]) -> None:
        """Raise NoConvergence if the readings that are left are not most of them."""
        total = sum(int(np.isfinite(one.readings_px).sum()) for one in self.recordings)
        used = sum(int(start.poses.seen.sum()) for start in starts)
        if used < MIN_SHARE * total:
            raise NoConvergence(
                f"only {used} of {total} readings agree with one another; the start is too "
                "wrong, the lengths do not belong to what was moved, or the standard deviations "
                "are far too small",
                used=used,
            )
