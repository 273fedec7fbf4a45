"""Pose filter: error-state Kalman filter of pose, velocity and angular velocity.

An error-state Kalman filter on SE(3) x R^6 with constant velocity (J. Sola, arXiv:1711.02508),
which a single reading can update: the markers of a strobed tool are never seen simultaneously, and
no pose is fitted to readings of different times.

The calibration error is the same in every frame. A filter that treated it as noise would average it
out and report a covariance that shrinks with the number of frames. Here it is *considered*
(S. F. Schmidt, Advances in Control Systems 3, 1966, doi:10.1016/B978-1-4831-6716-9.50011-4): the
state's correlation with the common errors is propagated, and they are never estimated. The residual
error of the correction table is one more common error for each marker and sensor.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtrs

from compute.measurement.measurement_model import PredictedMeasurements
from compute.pose.estimation.pose_equations import rotation_jacobian
from compute.pose.rigid_body import CentredMarkers
from compute.pose.settings import MotionSettings
from compute.transform import exp_so3

Array = NDArray[np.float64]

STATES = 12
ROTATION, POSITION, VELOCITY, ANGULAR_VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_IDENTITY = np.eye(STATES)
_ROTATION_BY_ANGULAR_VELOCITY = (np.arange(3), np.arange(9, 12))
_POSITION_BY_VELOCITY = (np.arange(3, 6), np.arange(6, 9))


@dataclass(frozen=True, eq=False)
class ReportedPose:
    """The reported pose of a tool.

    Args:
        rotation: R_world_tool, shape (3, 3).
        angular_velocity_rad_s: angular velocity about the world's axes, shape (3,) [rad/s].
        translation_mm: the tool's origin in the world, shape (3,) [mm].
        covariance: covariance of rotation (left) [rad] and translation [mm], shape (6, 6).
        tip_mm: tip in the world, shape (3,) [mm].
        tip_covariance_mm2: shape (3, 3) [mm^2].
        velocity_mm_s: velocity of the tool's origin, shape (3,) [mm/s].
        tip_variance_mm2: variance of the tip in 3D, the trace of its covariance [mm^2].
        pose_variance_mm2: trace of the covariance of (rotation times the markers' radius,
            centroid); no motion's variance is larger [mm^2].
    """

    rotation: Array
    angular_velocity_rad_s: Array
    translation_mm: Array
    covariance: Array
    tip_mm: Array
    tip_covariance_mm2: Array
    velocity_mm_s: Array
    tip_variance_mm2: float
    pose_variance_mm2: float


@dataclass(frozen=True, eq=False)
class PoseState:
    """State of a moving tool at a time.

    Args:
        time_ns: the time [ns].
        rotation: R_world_tool, shape (3, 3).
        centroid_mm: centroid of the markers in the world, shape (3,) [mm].
        velocity_mm_s: velocity of the centroid, shape (3,) [mm/s].
        angular_velocity_rad_s: angular velocity about the world's axes, shape (3,) [rad/s].
        covariance: covariance of rotation (left, about the centroid), position, velocity and
            angular velocity, shape (12, 12).
        common: covariance of these with the common errors, shape (12, E).
    """

    time_ns: int
    rotation: Array
    centroid_mm: Array
    velocity_mm_s: Array
    angular_velocity_rad_s: Array
    covariance: Array
    common: Array

    def marker_positions(self, centred: CentredMarkers) -> Array:
        """Return the markers in the world, shape (M, 3) [mm]."""
        positions: Array = centred.markers_mm @ self.rotation.T + self.centroid_mm
        return positions

    def reported_pose(self, centred: CentredMarkers) -> ReportedPose:
        """Return the reported pose of a tool with these markers."""
        here = self.covariance[:6, :6]
        wx, wy, wz = self.angular_velocity_rad_s.tolist()
        x, y, z = (self.rotation @ centred.centroid_mm).tolist()
        origin, tip = centred.origin_jacobian(self.rotation), centred.tip_jacobian(self.rotation)
        tip_covariance = tip @ here @ tip.T
        variance = here.diagonal()
        return ReportedPose(
            self.rotation,
            self.angular_velocity_rad_s,
            centred.translation(self.rotation, self.centroid_mm),
            origin @ here @ origin.T,
            self.centroid_mm + self.rotation @ centred.tip_mm,
            tip_covariance,
            self.velocity_mm_s - np.array([wy * z - wz * y, wz * x - wx * z, wx * y - wy * x]),
            float(tip_covariance.trace()),
            float(centred.radius_mm**2 * variance[:3].sum() + variance[3:].sum()),
        )


def initial_state(
    time_ns: int,
    rotation: Array,
    centroid_mm: Array,
    pose_covariance: Array,
    motion: MotionSettings,
    common_errors: int,
) -> PoseState:
    """Return the state of a tool of known pose and unknown velocities.

    Args:
        time_ns: time of the pose [ns].
        rotation: R_world_tool, shape (3, 3).
        centroid_mm: centroid of the markers in the world, shape (3,) [mm].
        pose_covariance: covariance of rotation [rad] and centroid [mm], shape (6, 6).
        motion: standard deviations of the unknown velocities.
        common_errors: number E of common errors, uncorrelated with the state.
    """
    covariance = np.zeros((STATES, STATES))
    covariance[:6, :6] = pose_covariance
    covariance[VELOCITY, VELOCITY] = motion.velocity_sigma_mm_s**2 * np.eye(3)
    covariance[ANGULAR_VELOCITY, ANGULAR_VELOCITY] = (
        motion.angular_velocity_sigma_rad_s** 2 * np.eye(3)
    )
    common, rest = np.zeros((STATES, common_errors)), np.zeros(3)
    return PoseState(time_ns, rotation, centroid_mm, rest, rest, covariance, common)


def predict(
    state: PoseState, time_ns: int, motion: MotionSettings, manoeuvre_factor: float = 1.0
) -> PoseState:
    """Predict a state to a later time.

    Args:
        state: the state.
        time_ns: the time, not earlier than the state's [ns].
        motion: RMS accelerations.
        manoeuvre_factor: factor on the accelerations.
    """
    step = 1e-9 * (time_ns - state.time_ns)
    if step == 0.0:
        return state
    turned = exp_so3(state.angular_velocity_rad_s * step)
    jacobian = _IDENTITY.copy()
    jacobian[ROTATION, ROTATION] = turned
    jacobian[_ROTATION_BY_ANGULAR_VELOCITY] = jacobian[_POSITION_BY_VELOCITY] = step
    covariance = jacobian @ state.covariance @ jacobian.T
    covariance += _process_noise(motion, manoeuvre_factor, step)
    common = jacobian @ state.common if state.common.shape[1] else state.common
    return propagate(state, time_ns, turned, covariance, common)


def propagate(
    state: PoseState, time_ns: int, turned: Array, covariance: Array, common: Array
) -> PoseState:
    """Return a state moved with its velocities, with the given covariances.

    Args:
        state: the state.
        time_ns: the later time [ns].
        turned: rotation in between, exp of angular velocity times time, shape (3, 3).
        covariance: covariance at the later time, shape (12, 12).
        common: covariance with the common errors there, shape (12, E).
    """
    step = 1e-9 * (time_ns - state.time_ns)
    return PoseState(
        time_ns,
        turned @ state.rotation,
        state.centroid_mm + state.velocity_mm_s * step,
        state.velocity_mm_s,
        state.angular_velocity_rad_s,
        covariance,
        common,
    )


def retract(state: PoseState, step: Array, covariance: Array, common: Array) -> PoseState:
    """Return a state corrected by an error-state increment, with the given covariances.

    Args:
        state: the state.
        step: increment of rotation (left), position, velocity and angular velocity, shape (12,).
        covariance: covariance afterwards, shape (12, 12).
        common: covariance with the common errors afterwards, shape (12, E).
    """
    return PoseState(
        state.time_ns,
        exp_so3(step[ROTATION]) @ state.rotation,
        state.centroid_mm + step[POSITION],
        state.velocity_mm_s + step[VELOCITY],
        state.angular_velocity_rad_s + step[ANGULAR_VELOCITY],
        covariance,
        common,
    )


@lru_cache(maxsize=1024)
def _process_noise(motion: MotionSettings, manoeuvre_factor: float, step_s: float) -> Array:
    """Return the process noise of a time step, shape (12, 12); not to be written to."""
    noise = np.zeros((STATES, STATES))
    same = np.eye(3)
    for pose, rate, size in (
        (POSITION, VELOCITY, motion.acceleration_mm_s2),
        (ROTATION, ANGULAR_VELOCITY, motion.angular_acceleration_rad_s2),
    ):
        density = 2.0 * (size * manoeuvre_factor) ** 2 * motion.manoeuvre_time_constant_s
        noise[pose, pose] = density * step_s**3 / 3.0 * same
        noise[pose, rate] = noise[rate, pose] = density * step_s**2 / 2.0 * same
        noise[rate, rate] = density * step_s * same
    return noise


@dataclass(frozen=True, eq=False)
class MeasurementPrediction:
    """n predicted readings, with what an update by them needs.

    Args:
        value_px: predicted readings, shape (n,) [px].
        jacobian: Jacobian with respect to rotation and position, shape (n, 6).
        common: Jacobian with respect to the common errors, shape (n, E).
        cross_covariance: covariance of state and predictions,
            ``covariance jacobian' + common_state common'``, shape (12, n).
        covariance: covariance of the predictions, without the readings' noise, shape (n, n)
            [px^2].
    """

    value_px: Array
    jacobian: Array
    common: Array
    cross_covariance: Array
    covariance: Array

    def of(self, rows: NDArray[np.intp]) -> "MeasurementPrediction":
        """Return the readings at the given indices."""
        return MeasurementPrediction(
            self.value_px[rows],
            self.jacobian[rows],
            self.common[rows],
            self.cross_covariance[:, rows],
            self.covariance[np.ix_(rows, rows)],
        )


def predict_measurement(
    state: PoseState, arms_mm: Array, expected: PredictedMeasurements, common: Array
) -> MeasurementPrediction:
    """Return the predicted readings of m markers by all S sensors, marker by marker.

    Args:
        state: the tool's state at the time of the readings.
        arms_mm: the markers less the centroid, along the world's axes, shape (m, 3) [mm].
        expected: predicted readings of the markers there.
        common: their Jacobian with respect to all common errors, shape (m, S, E).
    """
    slope = expected.jacobian_px_per_mm
    jacobian = np.empty((*slope.shape[:2], 6))
    rotation_jacobian(arms_mm[:, None, :], slope, jacobian)
    jacobian[..., 3:] = slope
    flat = jacobian.reshape(-1, 6)
    by_common = common.reshape(len(flat), -1) if common.shape[2] else np.empty((len(flat), 0))
    cross_covariance = state.covariance[:, :6] @ flat.T
    covariance = flat @ cross_covariance[:6]
    if by_common.shape[1]:
        crossed = flat @ state.common[:6] @ by_common.T
        cross_covariance = cross_covariance + state.common @ by_common.T
        covariance = covariance + crossed + crossed.T + by_common @ by_common.T
    return MeasurementPrediction(
        expected.reading_px.ravel(), flat, by_common, cross_covariance, covariance
    )


@dataclass(frozen=True, eq=False)
class FilterUpdate:
    """A state after readings.

    Args:
        state: the updated state.
        nis: normalised innovation squared of the readings that were used.
        accepted: indices of the readings that were used.
        whitened: whitened innovations and their Jacobian with respect to the common errors, shape
            (n, 1 + E); None: not kept.
    """

    state: PoseState
    nis: float
    accepted: NDArray[np.intp]
    whitened: Array | None = None


def update(
    state: PoseState, prediction: MeasurementPrediction, residual_px: Array, sigma_px: Array
) -> FilterUpdate:
    """Update a state by n readings.

    Args:
        state: the predicted state.
        prediction: the predicted readings.
        residual_px: readings less predictions, shape (n,) [px].
        sigma_px: standard deviations of the readings, shape (n,) [px].

    Raises:
        LinAlgError: the covariance of the readings is not positive definite.
    """
    count = len(residual_px)
    innovation_covariance = prediction.covariance.copy()
    innovation_covariance.flat[:: count + 1] += sigma_px**2
    common_errors = state.common.shape[1]
    # One triangular solve for residual, gains and common errors.
    right = np.empty((count, 1 + STATES + common_errors), order="F")
    right[:, 0] = residual_px
    right[:, 1 : 1 + STATES] = prediction.cross_covariance.T
    if common_errors:
        right[:, 1 + STATES :] = prediction.jacobian @ state.common[:6] + prediction.common
    root, failed = dpotrf(innovation_covariance, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the readings' covariance is not positive definite")
    solved, _ = dtrtrs(root, right, lower=1, overwrite_b=1)
    residual, gain = solved[:, 0], solved[:, 1 : 1 + STATES]
    # Exactly symmetric: the product of a matrix with its own transpose.
    after = retract(
        state,
        residual @ gain,
        state.covariance - gain.T @ gain,
        state.common - gain.T @ solved[:, 1 + STATES :] if common_errors else state.common,
    )
    return FilterUpdate(after, float(residual @ residual), np.arange(count))
