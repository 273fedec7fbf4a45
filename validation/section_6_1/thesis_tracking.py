"""The thesis's method of section 6.1: subsets, pair tracking along each sensor, differences."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import triangulate_linear
from compute.signal.peaks import PeakBatch
from validation.section_6.rotating_bar import (
    FRAMES,
    RATE_HZ,
    STILL_FRAMES,
    TURNING,
    Motion,
    Readings,
    cameras,
    readings,
    two_active,
)
from validation.section_6.scans import active_lines, fitted_peaks, thesis_points
from validation.section_6.sensor_track_errors import SensorFigures, sensor_figures
from validation.thesis_tracking.pair_tracker import Decision
from validation.thesis_tracking.pair_tracking import PairTracking
from validation.thesis_tracking.subsets import order_by_detection

Array = NDArray[np.float64]

SEED: Final = 61
TIMING_SIGMA_S: Final = 0.003
"""Deviation of an exposure's time about its place, where sampling is "unstable"; assumed."""
LIMIT_SHARE: Final = 0.5
"""The velocity limit delta, as a share of the targets' greatest velocity along the sensor; the
text has none. A crossing changes the velocity by up to twice that, the motion itself by a tenth."""


@dataclass(frozen=True)
class ActiveScene:
    """What the two active markers are seen under.

    Args:
        name: of the scene.
        sigma_px: of the lines.
        missed: share of the frames in which a sensor does not see a marker.
        timing_sigma_s: of the exposures' times.
        frames: of the sequence, from the first on.
    """

    name: str
    sigma_px: float
    missed: float
    timing_sigma_s: float
    frames: int = FRAMES


@dataclass(frozen=True, eq=False)
class Recorded:
    """A scene as the sensors see it.

    Args:
        motion: of the markers.
        truth: what the sensors would read.
        points_px: centres of gravity of each sensor, by the thesis's chain, (N, K) each.
        peaks: fitted, of each sensor.
    """

    motion: Motion
    truth: Readings
    points_px: tuple[Array, ...]
    peaks: tuple[PeakBatch, ...]


@dataclass(frozen=True, eq=False)
class PairTrack:
    """Both tracks along one sensor from the first frame in which both markers are seen.

    Args:
        first: that frame.
        markers: the marker in whose place each track starts, (2,).
        position_px: shape (N, 2), by tracks; NaN before ``first``.
        switched: where a track went over to the other subset, (N, 2).
        subsets_px: Subset 1 and 2, (N, 2).
    """

    first: int
    markers: NDArray[np.int64]
    position_px: Array
    switched: NDArray[np.bool_]
    subsets_px: Array


@cache
def record(scene: ActiveScene) -> Recorded:
    """Expose the scene, and find the peaks of all lines."""
    rng = np.random.default_rng(SEED)
    nominal = np.arange(scene.frames) / RATE_HZ
    motion = two_active(nominal + scene.timing_sigma_s * rng.standard_normal(scene.frames))
    truth = readings(motion, cameras())
    lines = [
        active_lines(truth.position_px[:, :, k], sensor, scene.sigma_px, scene.missed, rng)
        for k, sensor in enumerate(cameras())
    ]
    return Recorded(
        motion,
        truth,
        tuple(thesis_points(one) for one in lines),
        tuple(fitted_peaks(one, scene.sigma_px) for one in lines),
    )


@cache
def track_pair(scene: ActiveScene, sensor: int, decision: Decision = "velocity") -> PairTrack:
    """Track both markers along one sensor as section 6.1.3 does."""
    seen = record(scene)
    truth = seen.truth.position_px[:, :, sensor]
    subsets = order_by_detection(seen.points_px[sensor])
    both = np.flatnonzero(~np.isnan(subsets).any(axis=1))
    # Of sensor 1 the markers at rest are one behind the other: it starts when they have parted.
    first = int(both[both >= STILL_FRAMES - 1][0]) if sensor == 0 else int(both[0])
    speed = float(np.abs(seen.truth.velocity_px_s[:, :, sensor]).max())
    tracks = PairTracking(LIMIT_SHARE * speed, 1.0 / RATE_HZ, decision=decision).run(
        subsets[first:]
    )
    position = np.full(truth.shape, np.nan)
    position[first:] = tracks.position_px
    switched = np.zeros(truth.shape, dtype=np.bool_)
    switched[first:] = tracks.switched
    return PairTrack(first, np.argsort(truth[first]), position, switched, subsets)


def along_sensor(scene: ActiveScene, sensor: int, decision: Decision) -> SensorFigures:
    """Return how well both tracks along a sensor follow their markers."""
    seen, followed = record(scene), track_pair(scene, sensor, decision)
    truth = seen.truth.position_px[:, followed.markers, sensor]
    time = seen.motion.time_s
    nominal = np.full(len(time) - 1, 1.0 / RATE_HZ)
    return sensor_figures(
        followed.position_px[TURNING],
        cut(differences(followed.position_px, nominal)),
        truth[TURNING],
        cut(differences(truth, np.diff(time))),
    )


def cut(values: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return velocity and acceleration of the frames in which the bar turns evenly."""
    return values[0][TURNING], values[1][TURNING]


def differences(position: Array, interval_s: Array) -> tuple[Array, Array]:
    """Return velocity and acceleration by differences, each (N, ...), NaN where there is none.

    Velocity k is that between k - 1 and k; acceleration k is that of the velocities about k.

    Args:
        position: shape (N, ...).
        interval_s: shape (N - 1,).
    """
    shape = (-1, *(1,) * (position.ndim - 1))
    step = interval_s.reshape(shape)
    velocity = np.full_like(position, np.nan)
    velocity[1:] = np.diff(position, axis=0) / step
    acceleration = np.full_like(position, np.nan)
    acceleration[1:-1] = np.diff(velocity[1:], axis=0) / ((step[1:] + step[:-1]) / 2.0)
    return velocity, acceleration


def in_space(scene: ActiveScene, decision: Decision = "velocity") -> Array:
    """Return both markers' points by the tracks along the sensors, (N, 2, 3); NaN: not all four.

    Linear reconstruction from the readings of all four sensors: section 6.3.
    """
    tracks = np.full((scene.frames, 2, len(cameras())), np.nan)
    for sensor in range(len(cameras())):
        followed = track_pair(scene, sensor, decision)
        for track, marker in enumerate(followed.markers.tolist()):
            tracks[:, marker, sensor] = followed.position_px[:, track]
    flat = tracks.reshape(-1, len(cameras()))
    whole = ~np.isnan(flat).any(axis=1)
    points = np.full((len(flat), 3), np.nan)
    points[whole] = triangulate_linear(CameraStack.of(list(cameras())), flat[whole])
    return points.reshape(scene.frames, 2, 3)
