"""Kinematics of section 6.1 in space (Figure 6.17): differences, 8-state filter, our tracker."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.tracking.settings import TrackerSettings
from validation.section_6.rotating_bar import (
    BAR_MM,
    RATE_HZ,
    TURN_S,
    TURNING,
    Motion,
    cameras,
    readings,
)
from validation.section_6.sensor_track_errors import SPIKE, SensorFigures, sensor_figures
from validation.section_6.spatial_tracks import SpaceTracks, TrackingSettings, track
from validation.section_6_1.thesis_tracking import ActiveScene, differences, in_space, record
from validation.thesis_tracking.eight_state import EightState, EightStateModel
from validation.thesis_tracking.pair_tracker import Decision

Array = NDArray[np.float64]

READING_PX: Final = 0.05
"""Deviation of a centre of gravity, for the covariance of the points that the filter takes."""

_SPEED: Final = 2.0 * np.pi / TURN_S
JERK: Final = float((BAR_MM / 2.0 * _SPEED**3) ** 2 * TURN_S / 4.0)
"""Spectral density of the jerk [mm^2/s^5]: the bar's own, squared, times a quarter of a turn, in
which it keeps its direction."""


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Both markers in space.

    Args:
        position_mm, velocity_mm_s, acceleration_mm_s2: shape (N, 2, 3); NaN: none.
    """

    position_mm: Array
    velocity_mm_s: Array
    acceleration_mm_s2: Array


@dataclass(frozen=True)
class SpaceFigures:
    """How well two markers are known in space, over the frames in which the bar turns evenly.

    Args:
        position_rms_mm: along X, Y, Z.
        velocity_rms_mm_s: along X.
        acceleration_rms_mm_s2: along X.
        spikes: frames in which the velocity along X is off by more than half of the greatest.
        missing: share of the frames without a point.
    """

    position_rms_mm: tuple[float, float, float]
    velocity_rms_mm_s: float
    acceleration_rms_mm_s2: float
    spikes: int
    missing: float


@cache
def our_tracks(scene: ActiveScene, settings: TrackingSettings | None = None) -> SpaceTracks:
    """Track a scene by its fitted peaks, by our tracker or another method of a live device."""
    seen = record(scene)
    return track(
        seen.motion.time_s,
        seen.peaks,
        cameras(),
        seen.motion.position_mm,
        settings or TrackerSettings(),
    )


def our_kinematics(scene: ActiveScene, settings: TrackerSettings | None = None) -> Kinematics:
    """Return what our tracker says of both markers."""
    found = our_tracks(scene, settings)
    return Kinematics(found.position_mm, found.velocity_mm_s, found.acceleration_mm_s2)


def our_sensor_figures(scene: ActiveScene, sensor: int) -> SensorFigures:
    """Return our tracks' figures along a sensor, as ``along_sensor`` does the thesis's."""
    seen, found = record(scene), our_kinematics(scene)
    along = readings(
        Motion(
            seen.motion.time_s, found.position_mm, found.velocity_mm_s, found.acceleration_mm_s2
        ),
        cameras(),
    )
    truth = seen.truth
    return sensor_figures(
        along.position_px[TURNING, :, sensor],
        (along.velocity_px_s[TURNING, :, sensor], along.acceleration_px_s2[TURNING, :, sensor]),
        truth.position_px[TURNING, :, sensor],
        (truth.velocity_px_s[TURNING, :, sensor], truth.acceleration_px_s2[TURNING, :, sensor]),
    )


def by_differences(scene: ActiveScene, decision: Decision = "velocity") -> Kinematics:
    """Return points by the thesis's tracks and their differences, the frames equally apart."""
    points = in_space(scene, decision)
    velocity, acceleration = differences(points, np.full(len(points) - 1, 1.0 / RATE_HZ))
    return Kinematics(points, velocity, acceleration)


def by_eight_states(scene: ActiveScene, decision: Decision = "velocity") -> Kinematics:
    """Return the same points through the filter of [6.11]."""
    points = in_space(scene, decision)
    model = EightStateModel(jerk_psd=JERK, acceleration_psd=1e4)
    stack = CameraStack.of(list(cameras()))
    found = Kinematics(*(np.full_like(points, np.nan) for _ in range(3)))
    for marker in range(2):
        state: EightState | None = None
        for frame, point in enumerate(points[:, marker]):
            if np.isnan(point).any():
                continue
            slope = stack.linearise(point[None])[1][0] / READING_PX
            covariance = np.linalg.inv(slope.T @ slope)
            if state is None:
                state = EightState.at(point, covariance, 500.0, 3000.0)
            else:
                state, _ = state.predicted(model, 1.0 / RATE_HZ).updated(point, covariance)
            found.position_mm[frame, marker] = state.position_mm
            found.velocity_mm_s[frame, marker] = state.velocity_mm_s
            found.acceleration_mm_s2[frame, marker] = state.acceleration_mm_s2
    return found


def space_figures(found: Kinematics, truth: Kinematics) -> SpaceFigures:
    """Return the figures of kinematics beside the true ones."""

    def rms(one: Array, other: Array) -> Array:
        return np.asarray(np.sqrt(np.nanmean((one[TURNING] - other[TURNING]) ** 2, axis=(0, 1))))

    off = np.abs(found.velocity_mm_s - truth.velocity_mm_s)[TURNING, :, 0]
    greatest = float(np.nanmax(np.abs(truth.velocity_mm_s[..., 0])))
    x, y, z = rms(found.position_mm, truth.position_mm).tolist()
    return SpaceFigures(
        (x, y, z),
        float(rms(found.velocity_mm_s[..., :1], truth.velocity_mm_s[..., :1])[0]),
        float(rms(found.acceleration_mm_s2[..., :1], truth.acceleration_mm_s2[..., :1])[0]),
        int((off > SPIKE * greatest).sum()),
        float(np.isnan(found.position_mm[TURNING]).any(axis=2).mean()),
    )


def true_kinematics(scene: ActiveScene) -> Kinematics:
    """Return where the markers are, and how they move."""
    motion = record(scene).motion
    return Kinematics(motion.position_mm, motion.velocity_mm_s, motion.acceleration_mm_s2)


def true_differences(scene: ActiveScene) -> Kinematics:
    """Return what exact differences of exact points would be: a delay is no error of theirs."""
    motion = record(scene).motion
    velocity, acceleration = differences(motion.position_mm, np.diff(motion.time_s))
    return Kinematics(motion.position_mm, velocity, acceleration)
