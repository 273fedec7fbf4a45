"""Pose filter: a tool's pose, velocity and angular velocity, straight from readings of any time.

An error-state Kalman filter on SE(3) x R^6 with constant velocity (J. Sola, arXiv:1711.02508),
which a single reading can update: the markers of a strobed tool are never seen at one instant, and
no pose is fitted to readings of different times.

The calibration's error is the same in every frame. A filter that took it for noise would average it
away and state a covariance that shrinks with the number of frames. Here it is *considered*
(S. F. Schmidt, Advances in Control Systems 3, 1966, doi:10.1016/B978-1-4831-6716-9.50011-4): the
state's correlation with the common errors is carried along, and they are never estimated. What the
correction table leaves open is one more common error for each marker and sensor.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtrs

from compute.pose.marker_frame import MarkerFrame
from compute.pose.pose_equations import turn_slopes
from compute.pose.reading_model import ExpectedReadings
from compute.pose.settings import MotionSettings
from compute.pose.small import one_rotation

Array = NDArray[np.float64]

STATES = 12
TURN, PLACE, SPEED, RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_FREE = np.eye(STATES)
_TURN_BY_RATE = (np.arange(3), np.arange(9, 12))
_PLACE_BY_SPEED = (np.arange(3, 6), np.arange(6, 9))


@dataclass(frozen=True, eq=False)
class PoseFigures:
    """What is reported of a tool's pose.

    Args:
        rotation: R_world_tool, shape (3, 3).
        turn_rate_rad_s: about the world's axes, shape (3,) [rad/s].
        translation_mm: the tool's origin in the world, shape (3,) [mm].
        covariance: of turn (left) and translation, shape (6, 6).
        tip_mm: in the world, shape (3,) [mm].
        tip_covariance_mm2: shape (3, 3) [mm^2].
        velocity_mm_s: of the tool's origin, shape (3,) [mm/s].
    """

    rotation: Array
    turn_rate_rad_s: Array
    translation_mm: Array
    covariance: Array
    tip_mm: Array
    tip_covariance_mm2: Array
    velocity_mm_s: Array


@dataclass(frozen=True, eq=False)
class PoseState:
    """A moving tool at an instant.

    Args:
        time_ns: the instant [ns].
        rotation: R_world_tool, shape (3, 3).
        centroid_mm: of the markers in the world, shape (3,) [mm].
        velocity_mm_s: of the centroid, shape (3,) [mm/s].
        turn_rate_rad_s: angular velocity about the world's axes, shape (3,) [rad/s].
        covariance: of turn (left, about the centroid), place, velocity and angular velocity,
            shape (12, 12).
        common: covariance of these with the common errors, shape (12, E).
    """

    time_ns: int
    rotation: Array
    centroid_mm: Array
    velocity_mm_s: Array
    turn_rate_rad_s: Array
    covariance: Array
    common: Array

    def places(self, frame: MarkerFrame) -> Array:
        """Return the markers in the world, shape (M, 3) [mm]."""
        found: Array = frame.markers_mm @ self.rotation.T + self.centroid_mm
        return found

    def figures(self, frame: MarkerFrame) -> PoseFigures:
        """Return what is reported of a tool with these markers."""
        here = self.covariance[:6, :6]
        origin, tip = frame.origin_slopes(self.rotation), frame.tip_slopes(self.rotation)
        return PoseFigures(
            self.rotation,
            self.turn_rate_rad_s,
            frame.translation(self.rotation, self.centroid_mm),
            origin @ here @ origin.T,
            self.centroid_mm + self.rotation @ frame.tip_mm,
            tip @ here @ tip.T,
            origin_velocity(self, frame),
        )


def resting_state(
    time_ns: int,
    rotation: Array,
    centroid_mm: Array,
    pose_covariance: Array,
    motion: MotionSettings,
    common_errors: int,
) -> PoseState:
    """Return a state of which only the pose is known, with its covariance (6, 6)."""
    covariance = np.zeros((STATES, STATES))
    covariance[:6, :6] = pose_covariance
    covariance[SPEED, SPEED] = motion.speed_mm_s**2 * np.eye(3)
    covariance[RATE, RATE] = motion.turn_rate_rad_s**2 * np.eye(3)
    return PoseState(
        time_ns,
        rotation,
        centroid_mm,
        np.zeros(3),
        np.zeros(3),
        covariance,
        np.zeros((STATES, common_errors)),
    )


def predict(
    state: PoseState, time_ns: int, motion: MotionSettings, manoeuvre: float = 1.0
) -> PoseState:
    """Move a state on to a later instant.

    Args:
        state: where it was.
        time_ns: when it is wanted, not earlier.
        motion: how the velocities change.
        manoeuvre: factor on the accelerations.
    """
    step = 1e-9 * (time_ns - state.time_ns)
    if step == 0.0:
        return state
    turned = one_rotation(state.turn_rate_rad_s * step)
    slopes = _FREE.copy()
    slopes[TURN, TURN] = turned
    slopes[_TURN_BY_RATE] = slopes[_PLACE_BY_SPEED] = step
    covariance = slopes @ state.covariance @ slopes.T
    covariance += _process_noise(motion, manoeuvre, step)
    common = slopes @ state.common if state.common.shape[1] else state.common
    return advanced(state, time_ns, turned, covariance, common)


def advanced(
    state: PoseState, time_ns: int, turned: Array, covariance: Array, common: Array
) -> PoseState:
    """Return a state gone on at its velocities, turned (3, 3) meanwhile, with what is uncertain."""
    step = 1e-9 * (time_ns - state.time_ns)
    return PoseState(
        time_ns,
        turned @ state.rotation,
        state.centroid_mm + state.velocity_mm_s * step,
        state.velocity_mm_s,
        state.turn_rate_rad_s,
        covariance,
        common,
    )


def moved(state: PoseState, step: Array, covariance: Array, common: Array) -> PoseState:
    """Return a state that is off by a step (12,), with its covariance and that with the errors."""
    return PoseState(
        state.time_ns,
        one_rotation(step[TURN]) @ state.rotation,
        state.centroid_mm + step[PLACE],
        state.velocity_mm_s + step[SPEED],
        state.turn_rate_rad_s + step[RATE],
        covariance,
        common,
    )


@lru_cache(maxsize=1024)
def _process_noise(motion: MotionSettings, manoeuvre: float, step_s: float) -> Array:
    """Return the covariance that a time adds, shape (12, 12); not to be written to."""
    noise = np.zeros((STATES, STATES))
    same = np.eye(3)
    for pose, rate, size in (
        (PLACE, SPEED, motion.acceleration_mm_s2),
        (TURN, RATE, motion.turn_acceleration_rad_s2),
    ):
        density = 2.0 * (size * manoeuvre) ** 2 * motion.steady_s
        noise[pose, pose] = density * step_s**3 / 3.0 * same
        noise[pose, rate] = noise[rate, pose] = density * step_s**2 / 2.0 * same
        noise[rate, rate] = density * step_s * same
    return noise


@dataclass(frozen=True, eq=False)
class Innovations:
    """What n readings could tell of a state, but for their values.

    Args:
        value_px: what is expected of them, shape (n,) [px].
        slopes: of the readings by turn and place, shape (n, 6).
        common: of the readings by the common errors, shape (n, E).
        spread: ``covariance slopes' + common_state common'``, shape (12, n).
        covariance: of the expected values, without the readings' own noise, shape (n, n) [px^2].
    """

    value_px: Array
    slopes: Array
    common: Array
    spread: Array
    covariance: Array

    def of(self, rows: NDArray[np.intp]) -> "Innovations":
        """Return some of the readings."""
        return Innovations(
            self.value_px[rows],
            self.slopes[rows],
            self.common[rows],
            self.spread[:, rows],
            self.covariance[np.ix_(rows, rows)],
        )


def innovations(
    state: PoseState, arms_mm: Array, expected: ExpectedReadings, common: Array
) -> Innovations:
    """Return what all S readings of m markers are expected to be, marker by marker.

    Args:
        state: the tool at the readings' instant.
        arms_mm: the markers less the centroid, along the world's axes, shape (m, 3) [mm].
        expected: of the markers there.
        common: of their readings by all common errors, shape (m, S, E).
    """
    slope = expected.slope_px_per_mm
    slopes = np.empty((*slope.shape[:2], 6))
    turn_slopes(arms_mm[:, None, :], slope, slopes)
    slopes[..., 3:] = slope
    flat = slopes.reshape(-1, 6)
    by_common = common.reshape(len(flat), -1) if common.shape[2] else np.empty((len(flat), 0))
    spread = state.covariance[:, :6] @ flat.T
    covariance = flat @ spread[:6]
    if by_common.shape[1]:
        crossed = flat @ state.common[:6] @ by_common.T
        spread = spread + state.common @ by_common.T
        covariance = covariance + crossed + crossed.T + by_common @ by_common.T
    return Innovations(expected.value_px.ravel(), flat, by_common, spread, covariance)


@dataclass(frozen=True, eq=False)
class Update:
    """A state after readings.

    Args:
        state: the tool now.
        nis: normalised innovation squared of the readings that were used.
        kept: which of the readings were used, as indices.
        whitened: innovations of unit covariance and their slopes by the common errors, shape
            (n, 1 + E); None: not kept.
    """

    state: PoseState
    nis: float
    kept: NDArray[np.intp]
    whitened: Array | None = None


def update(state: PoseState, told: Innovations, residual_px: Array, sigma_px: Array) -> Update:
    """Take in n readings; ``residual_px`` is what they are less what was expected, (n,) [px]."""
    count = len(residual_px)
    whole = told.covariance.copy()
    whole.flat[:: count + 1] += sigma_px**2
    errors = state.common.shape[1]
    # One triangular solve for all: the residual, the gains and the common errors.
    right = np.empty((count, 1 + STATES + errors), order="F")
    right[:, 0] = residual_px
    right[:, 1 : 1 + STATES] = told.spread.T
    if errors:
        right[:, 1 + STATES :] = told.slopes @ state.common[:6] + told.common
    root, failed = dpotrf(whole, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the readings' covariance is not positive definite")
    solved, _ = dtrtrs(root, right, lower=1, overwrite_b=1)
    residual, gain = solved[:, 0], solved[:, 1 : 1 + STATES]
    step = residual @ gain
    # Symmetric to the bit: it is a matrix times itself.
    after = moved(
        state,
        step,
        state.covariance - gain.T @ gain,
        state.common - gain.T @ solved[:, 1 + STATES :] if errors else state.common,
    )
    return Update(after, float(residual @ residual), np.arange(count))


def origin_velocity(state: PoseState, frame: MarkerFrame) -> Array:
    """Return the velocity of the tool's origin, shape (3,) [mm/s]."""
    arm = state.rotation @ frame.centroid_mm
    wx, wy, wz = state.turn_rate_rad_s.tolist()
    x, y, z = arm.tolist()
    found: Array = state.velocity_mm_s - np.array(
        [wy * z - wz * y, wz * x - wx * z, wx * y - wy * x]
    )
    return found
