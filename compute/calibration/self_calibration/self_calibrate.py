"""self_calibrate: sensors from readings of a target at unknown poses, and one known length."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

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
from compute.calibration.self_calibration.pose_screening import (
    CURVATURE_LIMIT,
    check_poses_left,
    find_exchanges,
    find_outlier_readings,
    pose_curvature,
    screen_poses,
)
from compute.calibration.self_calibration.projective_reconstruction import SEED
from compute.calibration.self_calibration.recording_checks import (
    check_certainty,
    check_count,
    check_flat_readings,
    check_observed_scale,
    check_recordings,
    check_scale,
    check_volume_coverage,
    check_wave,
    device_scale,
    scale_warning,
)
from compute.calibration.self_calibration.result import (
    Datum,
    ExchangedReadings,
    RejectedMeasurement,
    SelfCalibration,
    summarise,
)
from compute.calibration.self_calibration.targets import Recording, RigidBody, Wand
from compute.calibration.self_calibration.uncalibrated_start import (
    check_uncalibrated,
    direction_vectors,
    pixel_directions,
    readings_noise,
    settle_handedness,
    uncalibrated_start,
    with_terms,
)
from compute.calibration.settings import CalibrationSettings, Distortion, preset_terms
from compute.camera.field_distortion import Term
from compute.camera.model import SensorGeometry, SensorModel
from compute.errors import (
    InvalidParameter,
    LumilineError,
    NoConvergence,
    TooFewPoints,
    UndeterminedParameters,
)
from compute.progress import Progress, no_progress

Array = NDArray[np.float64]

REJECTION_ROUNDS: Final = 20
MAX_ITERATIONS: Final = 2000
"""Trial steps of an adjustment: four sensors that miss many readings leave curved valleys, some of
which take 900."""
MIN_SHARE: Final = 0.6
"""Smallest share of the readings that must agree."""
NOISE_ROUNDS: Final = 2
SCALE_WARNING: Final = 0.02
"""Difference of the device's size to that of the start from which the lengths are in doubt."""
ALTERNATIVE_CHI2: Final = 10.0
"""Difference of chi2 to other cameras below which these are possible, too."""
NOISE_LIMIT: Final = 20.0
"""Noise that cameras from readings alone may leave, over the stated one: distortion that is not
fitted leaves ten times, other cameras than the right ones a hundred times."""
START_ATTEMPTS: Final = 6
"""Attempts at cameras from readings alone, each with other random subsets of the markers."""
RETRY_NOISE: Final = 2.0
"""Noise that they leave, over the stated one, above which they are attempted again."""
NOISE_WARNING: Final = 1.5
"""The same above which the result says that they may be wrong: the few redundant readings of 40
poses tell the noise to 15 %."""
Initial = Literal["start", "readings"]
SCREENING_ROUNDS: Final = 3


def self_calibrate(
    models: Sequence[SensorModel] | Sequence[SensorGeometry],
    recordings: Sequence[Recording],
    *,
    initial: Initial = "start",
    directions_deg: Sequence[float] | None = None,
    distortion: Distortion = "none",
    datum: Datum = "start",
    progress: Progress = no_progress,
) -> SelfCalibration:
    """Calibrate S sensors without known coordinates, from approximate cameras or from none.

    The start is the nominal geometry or an earlier calibration; it may be wrong by 20 % in every
    parameter (``lumiline reproduce wand`` gives the success rates). Without one, or with
    ``initial="readings"``, the initial cameras come from a wand's readings (``lumiline reproduce
    wand-from-readings``). All poses and all sensors are adjusted jointly, with a robust loss and
    rejection of outliers. Distortion terms of the start are adjusted, too.

    Args:
        models: the start, one for each sensor of the device; or their names and pixels alone.
        recordings: readings of wands, rigid bodies or frames, all with standard deviations or
            all without: then each sensor's comes from its residuals.
        initial: "start": begin at the given cameras. "readings": compute the initial cameras from
            a wand's readings; given cameras settle the frame and which of two mirror images counts.
        directions_deg: without given cameras, the directions in which readings grow, clockwise
            from the right, seen from the device towards the scene, shape (S,) [degrees]; to 20
            degrees they settle the mirror image.
        distortion: without given cameras, a named set of distortion terms, or the terms, to be
            adjusted; "none".
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
    try:
        return _calibrate_recordings(
            models, recordings, initial, directions_deg, distortion, datum, progress
        )
    except (UndeterminedParameters, NoConvergence):
        # A flat wave explains the failure better.
        check_flat_readings(recordings)
        raise


def _calibrate_recordings(
    models: Sequence[SensorModel] | Sequence[SensorGeometry],
    recordings: Sequence[Recording],
    initial: Initial,
    directions_deg: Sequence[float] | None,
    distortion: Distortion,
    datum: Datum,
    progress: Progress,
) -> SelfCalibration:
    sigma_given = {recording.sigma_px is not None for recording in recordings}
    if len(sigma_given) > 1:
        raise InvalidParameter("some recordings have standard deviations and some not; give all")
    if datum == "first-pose" and not isinstance(recordings[0].target, RigidBody):
        raise InvalidParameter(
            'datum is "first-pose", but the first recording is not of a rigid body of known shape'
        )
    progress(0.0, "start")
    begin = _begin(models, recordings, initial, directions_deg, distortion)
    scales = tuple(observed_scale(begin.reference, recording) for recording in recordings)
    progress(0.1, "search")
    work = _SelfCalibrationState(begin.reference, tuple(recordings), sigma_given == {True})
    if begin.initial is None:
        for observed in scales:
            check_observed_scale(observed)
        check_count(begin.reference, [start.poses for start in work.starts(trusted=False)])
    else:
        work.models = begin.initial
        check_count(work.models, [start.poses for start in work.starts()])
    begin, work, starts, adjusted = _solve(begin, work, scales, progress)
    certainty_warning = check_certainty(adjusted, recordings, [start.poses for start in starts])
    progress(0.95, "world frame")
    placed = _apply_datum(adjusted, begin.reference, starts, recordings, datum)
    scale = device_scale(begin.reference, placed.models) if begin.given else None
    warnings = begin.warnings + ((certainty_warning,) if certainty_warning else ())
    if scale is not None and abs(scale - 1.0) > SCALE_WARNING:
        warnings += (scale_warning(scale),)
    result = summarise(
        adjusted,
        placed,
        starts,
        recordings,
        datum=datum,
        start_scales=scales,
        device_scale=scale,
        rejected=work.rejected,
        exchanged=work.exchanged,
        warnings=warnings,
        sigma_given=work.sigma_given,
    )
    progress(1.0, "done")
    return result


@dataclass(frozen=True)
class _Begin:
    """Initial cameras of a self-calibration.

    Args:
        reference: cameras that define the frame; those given, or those from the readings.
        initial: cameras near the solution; None: the search begins at the reference.
        given: whether the reference was given.
        warnings: in sentences.
    """

    reference: tuple[SensorModel, ...]
    initial: tuple[SensorModel, ...] | None
    given: bool
    warnings: tuple[str, ...] = ()


def _begin(
    models: Sequence[SensorModel] | Sequence[SensorGeometry],
    recordings: Sequence[Recording],
    initial: Initial,
    directions_deg: Sequence[float] | None,
    distortion: Distortion,
) -> _Begin:
    terms = _distortion_terms(distortion)
    given = tuple(model for model in models if isinstance(model, SensorModel))
    if given and (directions_deg is not None or terms):
        raise InvalidParameter(
            "directions_deg and distortion are for sensors without initial cameras, which have "
            "both; leave them out"
        )
    if given and initial == "start":
        return _Begin(given, None, True)
    directions = None if directions_deg is None else direction_vectors(directions_deg)
    if given:
        directions = pixel_directions(given)
    elif directions is not None and len(directions) != len(models):
        raise InvalidParameter(
            f"directions_deg has {len(directions)} angles; give one for each of {len(models)} "
            "sensors"
        )
    return _begin_from_readings(models, recordings, given, directions, terms)


def _begin_from_readings(
    models: Sequence[SensorModel] | Sequence[SensorGeometry],
    recordings: Sequence[Recording],
    given: tuple[SensorModel, ...],
    directions: Array | None,
    terms: tuple[Term, ...],
) -> _Begin:
    """Return the best of some attempts at cameras from readings alone, with warnings.

    Raises:
        TooFewPoints: as ``uncalibrated_start``.
        NoConvergence: as ``uncalibrated_start``, or the best cameras leave far more noise than is
            stated.
    """
    sensors = [SensorGeometry(model.name, model.pixels) for model in models]
    stated = _stated_noise(recordings)
    best: _Begin | None = None
    least = np.inf
    for attempt in range(START_ATTEMPTS):
        try:
            begin = _cameras_from_readings(sensors, recordings, given, directions, terms, attempt)
        except NoConvergence:
            if best is None and attempt == START_ATTEMPTS - 1:
                raise
            continue
        noise = readings_noise(begin.initial or begin.reference, recordings)
        if best is None or noise < least:
            best, least = begin, noise
        if stated is None or least <= RETRY_NOISE * stated:
            break
    assert best is not None
    if not given and stated is not None and least > NOISE_LIMIT * stated:
        raise NoConvergence(
            f"the best cameras found from the readings alone leave {least:.2g} px where "
            f"{stated:.2g} px are stated: wave more poses that all sensors see, in all directions, "
            "near and far; or name distortion terms, or give initial cameras",
            noise_px=least,
        )
    if stated is not None and least > NOISE_WARNING * stated:
        warning = (
            f"The cameras found from the readings leave {least:.2g} px where {stated:.2g} px are "
            "stated, and may be wrong: wave the wand at more poses, in all directions, near and "
            "far, or name distortion terms."
        )
        best = replace(best, warnings=(*best.warnings, warning))
    return best


def _solve(
    begin: _Begin, work: "_SelfCalibrationState", observed: Sequence[float], progress: Progress
) -> tuple[_Begin, "_SelfCalibrationState", list[InitialPoses], AdjustmentResult]:
    """Adjust sensors and poses; where the search fails from given cameras, by other ways.

    Where readings are few, the coarse search may leave cameras that were right for others that fit
    hardly better. So given cameras are adjusted as they are then, and after that those from the
    readings alone.

    Args:
        begin: where to begin.
        work: its state, in which the initial cameras are set.
        observed: lengths as the reference sees them over the known ones, of each recording.
        progress: called with the fraction done and the stage.

    Returns:
        Where the successful way began, its state, its poses, and the adjustment.

    Raises:
        TooFewPoints: as ``coarse_solution``.
        DegeneratePoints, InvalidParameter: as ``check_volume_coverage`` and ``check_scale``.
        NoConvergence, UndeterminedParameters: all ways failed; the first way's reason.
    """
    recordings, given = work.recordings, begin.reference

    def search() -> _Begin:
        return replace(begin, initial=coarse_solution(given, work.kept_recordings(), work.sigma))

    def from_readings() -> _Begin:
        check_uncalibrated(len(given), recordings)
        return _begin_from_readings(given, recordings, given, pixel_directions(given), ())

    ways: list[Callable[[], _Begin]] = [lambda: begin]
    if begin.initial is None:
        ways = [search, lambda: replace(begin, initial=given), from_readings]
    failures: list[LumilineError] = []
    for way in ways:
        try:
            beginning = way()
            work = _SelfCalibrationState(given, recordings, work.sigma_given)
            assert beginning.initial is not None
            work.models = beginning.initial
            if begin.given:
                check_scale(given, work.models, observed)
            progress(0.5, "adjustment")
            check_volume_coverage([start.poses for start in work.starts()])
            starts, adjusted = _adjust_explained(work, progress)
            if begin.given:
                check_scale(given, work.models, observed)
        except (NoConvergence, UndeterminedParameters) as error:
            failures.append(error)
        except TooFewPoints:
            if not failures:
                raise
        else:
            return beginning, work, starts, adjusted
    raise failures[0]


def _adjust_explained(
    work: "_SelfCalibrationState", progress: Progress
) -> tuple[list[InitialPoses], AdjustmentResult]:
    try:
        return work.solve(progress)
    except (UndeterminedParameters, NoConvergence):
        check_wave(work.recordings, [start.poses for start in work.starts()])
        raise


def _cameras_from_readings(
    sensors: Sequence[SensorGeometry],
    recordings: Sequence[Recording],
    given: tuple[SensorModel, ...],
    directions: Array | None,
    terms: tuple[Term, ...],
    attempt: int,
) -> _Begin:
    """Compute initial cameras from a wand's readings, in the frame of given cameras if any.

    Each attempt tries other random subsets of the markers.
    """
    found = uncalibrated_start(sensors, recordings, SEED + attempt)
    warnings = []
    if found.alternative_chi2 < ALTERNATIVE_CHI2:
        warnings.append(
            f"Other cameras fit nearly as well (chi2 larger by {found.alternative_chi2:.1f}); "
            "wave the wand at more poses, in all directions, near and far."
        )
    cameras, handedness_warning = settle_handedness(found.models, directions)
    if handedness_warning:
        warnings.append(handedness_warning)
    if given:
        cameras = tuple(
            replace(camera, distortion=model.distortion)
            for camera, model in zip(align_to_start(cameras, given), given, strict=True)
        )
        return _Begin(given, cameras, True, tuple(warnings))
    if terms:
        cameras = with_terms(cameras, recordings, terms)
    return _Begin(cameras, cameras, False, tuple(warnings))


def _stated_noise(recordings: Sequence[Recording]) -> float | None:
    """Return the median standard deviation of wands' readings [px]; None: not stated."""
    stated = [
        one.sigma_px[np.isfinite(one.readings_px)]
        for one in recordings
        if one.sigma_px is not None and isinstance(one.target, Wand)
    ]
    return float(np.median(np.concatenate(stated))) if stated else None


def _distortion_terms(distortion: Distortion) -> tuple[Term, ...]:
    if distortion == "auto":
        raise InvalidParameter(
            'distortion is "auto", which needs control points; name a set of terms, such as '
            '"symmetric-3", and compare chi2 per degree of freedom with "none"',
            distortion=distortion,
        )
    CalibrationSettings(distortion=distortion)
    return preset_terms(distortion) if isinstance(distortion, str) else distortion


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
            np.ones(one.readings_px.shape) if one.sigma_px is None else one.sigma_px.copy()
            for one in self.recordings
        ]
        self.rejected: list[RejectedMeasurement] = []
        self.exchanged: list[ExchangedReadings] = []

    def kept_recordings(self) -> list[Recording]:
        """Return the recordings without rejected readings."""
        return [
            Recording(recording.target, readings)
            for recording, readings in zip(self.recordings, self.readings, strict=True)
        ]

    def starts(self, trusted: bool = True) -> list[InitialPoses]:
        """Fit all poses to the current cameras, without undetermined ones."""
        starts = []
        for recording, sigma in zip(self.kept_recordings(), self.sigma, strict=True):
            start = start_poses(self.models, recording, sigma, trusted=trusted)
            starts.append(start.select(~undetermined_poses(self.models, start.poses)))
        return starts

    def consistent_poses(self) -> list[InitialPoses]:
        """Fit all poses to the current cameras, without contradictory ones."""
        return [screen_poses(self.models, start).consistent for start in self.starts()]

    def screen_poses(self) -> list[InitialPoses]:
        """Fit all poses to the current cameras, without contradictory and ambiguous ones.

        Raises:
            NoConvergence: a recording has no others.
        """
        starts = [
            start.select(pose_curvature(self.models, start.poses) <= CURVATURE_LIMIT)
            for start in self.consistent_poses()
        ]
        check_poses_left(starts)
        return starts

    def without_outliers(self) -> tuple[list[InitialPoses], AdjustmentResult]:
        """Reject outliers and repair exchanges until none is left; return poses and adjustment."""
        self.reject_single_outliers()
        self.repair_exchanges()
        for _ in range(REJECTION_ROUNDS):
            starts = self.screen_poses()
            adjusted = self.adjusted(starts)
            if not self.reject(adjusted, starts):
                break
        return starts, adjusted

    def restore_readings(self) -> None:
        """Take back all rejections and exchanges."""
        self.readings = [recording.readings_px.copy() for recording in self.recordings]
        names = [model.name for model in self.models]
        for one in self.exchanged:
            sigma = self.sigma[one.recording - 1][one.pose - 1, :, names.index(one.sensor)]
            pair = [one.first - 1, one.second - 1]
            sigma[pair] = sigma[pair[::-1]]
        self.rejected, self.exchanged = [], []

    def reject_single_outliers(self) -> None:
        """Reject the single outlier of each contradictory pose that has one."""
        for number, start in enumerate(self.starts()):
            fitted = screen_poses(self.models, start)
            bad = start.poses.select(~fitted.good)
            if len(bad):
                poses, indices, residuals = find_outlier_readings(self.models, bad)
                pose_index = start.pose_index[~fitted.good][poses]
                self._reject_readings(number, np.column_stack([pose_index, indices]), residuals)

    def repair_exchanges(self) -> None:
        """Exchange two markers' readings of one sensor where that alone explains a pose."""
        for number, start in enumerate(self.starts()):
            fitted = screen_poses(self.models, start)
            found = find_exchanges(self.models, start.poses.select(~fitted.good))
            for pose, first, second, sensor in found:
                index = int(start.pose_index[~fitted.good][pose])
                for values in (self.readings[number], self.sigma[number]):
                    values[index, [first, second], sensor] = values[index, [second, first], sensor]
                name = self.models[sensor].name
                self.exchanged.append(
                    ExchangedReadings(number + 1, index + 1, first + 1, second + 1, name)
                )

    def adjusted(self, starts: Sequence[InitialPoses]) -> AdjustmentResult:
        """Adjust all sensors and poses, and keep the cameras."""
        pose_sets = [start.poses for start in starts]
        adjusted = adjust(
            self.models,
            pose_sets,
            prior=lens_offset_prior(self.start, pose_sets),
            free_datum=True,
            max_iterations=MAX_ITERATIONS,
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

    def solve(self, progress: Progress) -> tuple[list[InitialPoses], AdjustmentResult]:
        """Adjust cameras and poses, without outliers, with the noise estimated from the readings.

        Args:
            progress: called with the fraction done and the stage.

        Raises:
            UndeterminedParameters, NoConvergence: as ``self_calibrate``.
        """
        for _ in range(SCREENING_ROUNDS):
            adjusted = self.adjusted(self.screen_poses())
            if not self.sigma_given:
                self.scale_sigma(sensor_sigma(adjusted, robust=True))
        progress(0.7, "outliers")
        starts, adjusted = self.without_outliers()
        if self.rejected or self.exchanged:
            # What less accurate cameras took for an outlier may be none.
            self.restore_readings()
            starts, adjusted = self.without_outliers()
        if not self.sigma_given:
            for _ in range(NOISE_ROUNDS):
                self.scale_sigma(sensor_sigma(adjusted, robust=False))
                starts = self.screen_poses()
                adjusted = self.adjusted(starts)
        self.check_share()
        return starts, adjusted

    def check_share(self) -> None:
        """Check that enough of the readings agree with one another.

        Raises:
            NoConvergence: too large a share of them was rejected.
        """
        total = 0
        for one in self.recordings:
            # Poses with too few readings can be placed by no cameras; they contradict nothing.
            seen = np.isfinite(one.readings_px).sum(axis=2)
            markers = 2 if isinstance(one.target, Wand) else 3
            total += int(seen[(seen >= 3).sum(axis=1) >= markers].sum())
        used = sum(int(start.poses.observed_mask.sum()) for start in self.consistent_poses())
        if used < MIN_SHARE * total:
            raise NoConvergence(
                f"only {used} of {total} readings of poses that show enough markers agree with "
                "one another; the start is too wrong, the lengths do not belong to what was "
                "moved, or the standard deviations are far too small",
                used=used,
            )
