"""Checks of recordings for self-calibration: number of poses, coverage, units of lengths."""

from collections.abc import Sequence
from functools import partial
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.self_calibration.datum import rotation_between
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.observation_checks import FLATNESS_LIMIT, check_inside
from compute.errors import (
    DegeneratePoints,
    InvalidParameter,
    NoConvergence,
    TooFewPoints,
    UndeterminedParameters,
)

Array = NDArray[np.float64]

SCALE_LIMIT: Final = 1.6
"""Largest ratio, either way, of the distances between the lenses to those of the start."""
OBSERVED_SCALE_LIMIT: Final = 200.0
"""Largest ratio, either way, of lengths as the starting cameras see them to the known ones; cameras
that are 30 % wrong, with angles wrong by 5 degrees, reached 85."""
UNITS: Final = {"m": 1000.0, "cm": 10.0, "inches": 25.4, "feet": 304.8}
UNIT_TOLERANCE: Final = 1.6
CONIC_LIMIT: Final = 0.01
"""Smallest singular value, of the largest, of the squares and products of the directions of known
lengths: directions in a plane or on a cone have 0, 200 random ones 0.3."""
WEAK_CONIC_LIMIT: Final = 0.1
"""The same where the cameras turn out uncertain: noise lifts directions off their cone."""
DISTANCE_UNCERTAINTY_LIMIT: Final = 0.03
"""Relative standard deviation of a principal distance from which cameras are uncertain."""
DISTANCE_UNKNOWN_LIMIT: Final = 0.3
"""The same from which nothing can be measured with them."""
FLAT_READINGS_LIMIT: Final = 3.0
"""RMS distance, over the noise, of any three sensors' readings from the equation of markers in a
plane: without depth it is 1; with less than 3 no camera is known. Only failures are explained by
it."""
MIN_FLATNESS_MARKERS: Final = 24
"""Markers that three sensors read from which their readings are tested; the equation has seven
unknowns."""
FLATNESS_ROUNDS: Final = 5


def check_recordings(
    models: Sequence[SensorModel] | Sequence[SensorGeometry], recordings: Sequence[Recording]
) -> None:
    """Check number of sensors, shapes, and that readings lie on the sensors.

    Args:
        models: the starting cameras, or names and pixels.
        recordings: the readings.

    Raises:
        InvalidParameter: no recording, or readings of another number of sensors.
        ReadingOutsideSensor: a reading lies beyond the sensor's pixels.
        TooFewPoints: fewer than three sensors.
    """
    if len(models) < 3:
        raise TooFewPoints(
            f"{len(models)} sensors make no points; a calibration without known coordinates "
            "needs three, and four to notice what is wrong",
            sensors=len(models),
        )
    if not recordings:
        raise InvalidParameter("no recordings; give one at least")
    for number, recording in enumerate(recordings):
        if recording.readings_px.shape[2] != len(models):
            raise InvalidParameter(
                f"recording {number + 1} has readings of {recording.readings_px.shape[2]} "
                f"sensors; the device has {len(models)}"
            )
        check_inside(recording.readings_px.reshape(-1, len(models)), models)


def check_scale(
    start: Sequence[SensorModel], found: Sequence[SensorModel], observed: Sequence[float]
) -> None:
    """Check that the known lengths agree with the size of the starting device.

    Args:
        start: the S starting cameras.
        found: the S cameras of the solution.
        observed: lengths as the starting cameras see them over the known ones, of each recording.

    Raises:
        InvalidParameter: they contradict each other, most likely by a unit.
        NoConvergence: the starting cameras see them right, and the solution does not.
    """
    scale = device_scale(start, found)
    if _is_plausible(scale):
        return
    if all(_is_plausible(one) for one in observed):
        raise NoConvergence(
            f"the search ended at cameras of a device {scale:.4g} times as large as the initial "
            "one, which sees the known lengths right: the readings hardly tell the cameras; take "
            "more poses that all sensors see, in all directions, near and far",
            scale=scale,
        )
    raise InvalidParameter(
        f"the given lengths make the device {scale:.4g} times as large as the cameras to start "
        f"from; {_unit_hint(1.0 / scale)}",
        scale=scale,
    )


def _is_plausible(scale: float) -> bool:
    return 1.0 / SCALE_LIMIT <= scale <= SCALE_LIMIT


def scale_warning(scale: float) -> str:
    """Return the warning of lengths that disagree with the size of the starting device.

    Args:
        scale: size of the solved device over that of the start.
    """
    return (
        f"The known lengths make the device {scale:.4g} times as large as the initial cameras: all "
        f"distances will measure {100.0 * (scale - 1.0):+.1f} % different from before. Check the "
        "length of what was moved; keep the result only if the initial cameras were approximate."
    )


def check_observed_scale(scale: float) -> None:
    """Check the ratio of lengths as the starting cameras see them to the known ones.

    Raises:
        InvalidParameter: they contradict each other by more than a start can be wrong.
    """
    if np.isfinite(scale) and not 1.0 / OBSERVED_SCALE_LIMIT <= scale <= OBSERVED_SCALE_LIMIT:
        raise InvalidParameter(
            f"the cameras to start from see the lengths {scale:.4g} times as long as given; "
            f"{_unit_hint(scale)}",
            scale=scale,
        )


def _unit_hint(factor: float) -> str:
    for unit, size in UNITS.items():
        if 1.0 / UNIT_TOLERANCE < factor / size < UNIT_TOLERANCE:
            return f"were they given in {unit}? They must be in mm"
    return "check their unit (mm) and that of the start's cameras"


def device_scale(start: Sequence[SensorModel], found: Sequence[SensorModel]) -> float:
    """Return the size of the solved device over that of the start, about their centres.

    The scale is fitted along with a rigid motion, to the lenses' positions across their slits.

    Args:
        start: the S starting cameras.
        found: the S cameras of the solution.
    """
    rotation = rotation_between(found, start)
    rows, right = [], []
    for old, new in zip(start, found, strict=True):
        turned = new.rotation @ rotation.T
        # o_old = (o_new - R' t) / scale
        rows += [(old.offset_x_mm, *turned[0]), (old.offset_z_mm, *turned[2])]
        right += [new.offset_x_mm, new.offset_z_mm]
    return float(np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0][0])


def check_volume_coverage(pose_sets: Sequence[PoseSet], conic_limit: float = CONIC_LIMIT) -> None:
    """Check that markers fill a volume and known lengths determine the scale in all directions.

    Lengths fix the six scales and shears of space (a symmetric matrix Q with ``d' Q d = 1`` for
    the directions d) unless the directions lie on one cone or plane.

    Args:
        pose_sets: the poses.
        conic_limit: see CONIC_LIMIT.

    Raises:
        DegeneratePoints: all markers in one plane, or all lengths parallel, in one plane or on a
            cone.
    """
    markers = np.concatenate([poses.marker_positions().reshape(-1, 3) for poses in pose_sets])
    extent = np.linalg.svd(markers - markers.mean(axis=0), compute_uv=False)
    if extent[2] < FLATNESS_LIMIT * extent[0]:
        raise DegeneratePoints(
            f"all {len(markers)} markers lie in one plane, which leaves the sensors' parameters "
            "undetermined; move the target nearer and farther too"
        )
    directions = np.concatenate([_directions(poses) for poses in pose_sets])
    if any(poses.shape.distances for poses in pose_sets):
        # A rigid body of unknown shape says by itself that its lengths are the same all round.
        return
    if conic_share(directions) > conic_limit:
        return
    direction_shares = np.linalg.svd(directions, compute_uv=False) / np.sqrt(len(directions))
    alike = (
        "all parallel"
        if direction_shares[1] < 0.1
        else "all in one plane"
        if direction_shares[2] < 0.03
        # Cameras that are still uncertain may flatten a cone.
        else "all in one plane or on a cone"
        if direction_shares[2] < 0.1
        else "too few or all on a cone"
    )
    raise DegeneratePoints(
        f"the {len(directions)} known lengths are {alike} (RMS shares {direction_shares[0]:.2f}, "
        f"{direction_shares[1]:.2f}, {direction_shares[2]:.2f} of their directions), which leaves "
        "the scale in other directions open; rotate the target in all directions, towards the "
        "sensors too"
    )


def conic_share(directions: Array) -> float:
    """Return how far directions are from lying on one cone or plane: see CONIC_LIMIT.

    Args:
        directions: unit vectors, shape (N, 3).

    Returns:
        Smallest singular value of their squares and products, of the largest; 0 for fewer than six.
    """
    if len(directions) < 6:
        return 0.0
    x, y, z = directions.T
    products = np.stack([x * x, y * y, z * z, x * y, y * z, z * x], axis=1)
    singular = np.linalg.svd(products, compute_uv=False)
    return float(singular[5] / singular[0])


def check_certainty(
    adjusted: AdjustmentResult, recordings: Sequence[Recording], pose_sets: Sequence[PoseSet]
) -> str:
    """Check that the readings determine the cameras, and return a warning where hardly; else "".

    Args:
        adjusted: the solution.
        recordings: the readings.
        pose_sets: its poses.

    Raises:
        DegeneratePoints: as ``check_volume_coverage``; as ``check_wave``, where a principal
            distance is uncertain.
        UndeterminedParameters: one is next to unknown, for another reason.
    """
    # The cameras that the search began with were others.
    check_volume_coverage(pose_sets)
    variance = np.diagonal(adjusted.sensor_covariance)
    first = 0
    worst, sensor = 0.0, ""
    for model in adjusted.models:
        uncertainty = float(np.sqrt(variance[first])) / model.principal_distance_px
        worst, sensor = max((worst, sensor), (uncertainty, model.name))
        first += model.parameter_count
    if worst <= DISTANCE_UNCERTAINTY_LIMIT:
        return ""
    check_wave(recordings, pose_sets)
    if worst > DISTANCE_UNKNOWN_LIMIT:
        raise UndeterminedParameters(
            f"the readings leave the principal distance of sensor {sensor} open: its standard "
            f"deviation is {100.0 * worst:.3g} % of it, at most {100.0 * DISTANCE_UNKNOWN_LIMIT:g} "
            "% is accepted; take more poses, in all directions, near and far",
            sensor=sensor,
        )
    return (
        f"The readings determine the principal distance of sensor {sensor} to {100.0 * worst:.2g} "
        f"% only (standard deviation; {100.0 * DISTANCE_UNCERTAINTY_LIMIT:g} % and less is good), "
        "so positions may be wrong by as much of their distance from one another: wave the wand "
        "at more poses that all sensors see, in all directions, near and far."
    )


def check_flat_readings(recordings: Sequence[Recording]) -> None:
    """Check, without cameras, that the markers of wands do not lie in one plane.

    Three linear sensors that see the points of a plane are three 1D cameras of a 2D world: their
    readings satisfy one equation that is linear in each of them (the trifocal tensor of 1D
    cameras). Those of points in a volume are independent.

    Args:
        recordings: of wands; others are not used. Readings without standard deviations count as
            having 1 px.

    Raises:
        DegeneratePoints: the readings of any three sensors satisfy it, to their noise.
    """
    wands = [one for one in recordings if isinstance(one.target, Wand)]
    if not wands:
        return
    sensors = wands[0].readings_px.shape[2]
    readings = np.concatenate([one.readings_px.reshape(-1, sensors) for one in wands])
    sigma = np.concatenate(
        [
            np.broadcast_to(1.0 if one.sigma_px is None else one.sigma_px, one.readings_px.shape)
            for one in wands
        ]
    ).reshape(-1, sensors)
    misfits = []
    for three in combinations(range(sensors), 3):
        read = readings[:, three]
        complete = np.isfinite(read).all(axis=1)
        if complete.sum() >= MIN_FLATNESS_MARKERS:
            noise = float(np.median(sigma[:, three][complete]))
            misfits.append(_planar_misfit_px(read[complete]) / noise)
    if misfits and max(misfits) < FLAT_READINGS_LIMIT:
        count = int((np.isfinite(readings).sum(axis=1) >= 3).sum())
        raise DegeneratePoints(
            f"the {count} markers that three sensors read seem to be all in one plane: their "
            f"readings satisfy its equation to {max(misfits):.2g} standard deviations, which "
            "leaves the sensors' parameters undetermined; wave the wand nearer and farther, and "
            "towards the sensors too"
        )


def _planar_misfit_px(readings: Array) -> float:
    """Return the RMS distance of readings from the equation of points in a plane [px].

    Args:
        readings: of three sensors, shape (N, 3) [px]. The tenth that is farthest off does not
            count: single wrong readings are not depth.
    """
    scale = np.std(readings, axis=0)
    a, b, c = ((readings - np.median(readings, axis=0)) / scale).T
    one, zero = np.ones_like(a), np.zeros_like(a)
    terms = np.stack([one, a, b, c, a * b, a * c, b * c, a * b * c], axis=1)
    slopes = np.stack(
        [
            np.stack([zero, one, zero, zero, b, c, zero, b * c], axis=1) / scale[0],
            np.stack([zero, zero, one, zero, a, zero, c, a * c], axis=1) / scale[1],
            np.stack([zero, zero, zero, one, zero, a, b, a * b], axis=1) / scale[2],
        ]
    )
    used = np.ones(len(readings), dtype=np.bool_)
    for _ in range(FLATNESS_ROUNDS):
        equation = np.linalg.svd(terms[used], full_matrices=False)[2][-1]
        gradient = np.linalg.norm(slopes @ equation, axis=0)
        distance = np.abs(terms @ equation) / np.maximum(gradient, np.finfo(np.float64).tiny)
        used = distance <= np.quantile(distance, 0.9)
    return float(np.sqrt((distance[used] ** 2).sum() / (used.sum() - 7)))


def check_wave(recordings: Sequence[Recording], pose_sets: Sequence[PoseSet]) -> None:
    """Check whether a degenerate wave explains that an adjustment failed.

    Args:
        recordings: the readings.
        pose_sets: their poses by the cameras of the failed adjustment.

    Raises:
        DegeneratePoints: the markers lie near a plane, or the known lengths' directions near a
            cone; both are named where both may be, since the cameras are uncertain.
    """
    reasons = []
    for check in (
        partial(check_flat_readings, recordings),
        partial(check_volume_coverage, pose_sets, WEAK_CONIC_LIMIT),
    ):
        try:
            check()
        except DegeneratePoints as error:
            reasons.append(error.detail)
    if reasons:
        raise DegeneratePoints("; or ".join(reasons))


def _directions(poses: PoseSet) -> Array:
    marker = poses.marker_positions()
    first, second = np.triu_indices(len(poses.shape), 1)
    seen = poses.observed_mask.sum(axis=2) >= 2
    both = seen[:, first] & seen[:, second]
    between = (marker[:, first] - marker[:, second])[both]
    return np.asarray(between / np.linalg.norm(between, axis=1, keepdims=True))


def check_count(models: Sequence[SensorModel], pose_sets: Sequence[PoseSet]) -> None:
    """Check that there are more readings than unknowns.

    Args:
        models: the sensors.
        pose_sets: the starting poses.

    Raises:
        TooFewPoints: too few; the message says how many poses would do.
    """
    unknown = sum(model.parameter_count for model in models) - 6
    left = 0
    for poses in pose_sets:
        known = 0 if not np.isfinite(poses.shape.sigma_mm) else poses.shape.unknowns
        unknown += poses.shape.unknowns - known - len(poses.shape.distances)
        left += int((poses.observed_mask.sum(axis=(1, 2)) - poses.unknowns).sum())
    if left <= unknown:
        count = sum(len(poses) for poses in pose_sets)
        each = left / count
        enough = "" if each <= 0 else f"; about {int(np.ceil(1.5 * unknown / each))} would do"
        raise TooFewPoints(
            f"{count} poses, whose readings are {left} more than their own unknowns, for "
            f"{unknown} unknowns of the device{enough}",
            poses=count,
        )
