"""Initial states of tracks, from readings at a point or from a prior."""

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.measurement.measurement_model import MeasurementModel
from compute.reconstruction.triangulation import chi2_limit
from compute.tracking.motion_model import ImmStates, MotionModels, mix_and_predict
from compute.tracking.settings import TrackerSettings
from compute.tracking.unassociated_points import update_with_points
from compute.tracking.viterbi_linking import PointSequence

Array = NDArray[np.float64]

REPLAY_EXCLUSION_PROBABILITY = 1e-4
"""Probability that a marker's own point lies outside its gate."""
_MOVING = 6
_ASYMMETRY_TOLERANCE = 1e-9
"""Difference of a covariance from its transpose, in parts of its largest entry."""
_SPEEDS, _ACCELERATIONS = np.arange(3, 6), np.arange(6, 9)


def states_from_points(
    model: MeasurementModel,
    motion: MotionModels,
    settings: TrackerSettings,
    position_mm: Array,
    sigma_px: Array,
) -> tuple[ImmStates, Array]:
    """Return initial states at points, and the covariance of the readings' constant errors there.

    The position has the covariance of the readings' weighted least squares, and the covariance with
    the sensors' constant errors that this solution gives it.

    Args:
        model: of the readings.
        motion: M models.
        settings: deviations of speed and acceleration at the start.
        position_mm: shape (N, 3).
        sigma_px: of the positions' readings, shape (N, S); NaN where there is none.

    Returns:
        The states, and the constant errors' covariance, shape (N, S, S) [px^2].
    """
    count, sensors = sigma_px.shape
    used = np.isfinite(sigma_px)
    bias = model.systematic_covariance(position_mm)
    jacobian = np.where(used[..., None], model.predict(position_mm).jacobian_px_per_mm, 0.0)
    both = used[:, :, None] & used[:, None, :]
    noise = np.where(both, bias, 0.0)
    diagonal = np.arange(sensors)
    noise[:, diagonal, diagonal] += np.where(used, sigma_px, 1.0) ** 2
    weighted = np.linalg.solve(noise, jacobian).swapaxes(-1, -2)
    position_covariance = np.linalg.inv(weighted @ jacobian)
    bias_cross_covariance = -(position_covariance @ weighted) @ bias

    mean = np.zeros((count, _MOVING))
    mean[:, :3] = position_mm
    covariance = np.zeros((count, _MOVING, _MOVING))
    covariance[:, :3, :3] = position_covariance
    covariance[:, _SPEEDS, _SPEEDS] = settings.start_speed_mm_s**2
    states = states_from_prior(motion, settings, mean, covariance, sensors)
    states.bias_cross_covariance[..., :3, :] = bias_cross_covariance[:, None]
    return states, bias


def states_from_prior(
    motion: MotionModels,
    settings: TrackerSettings,
    mean: Array,
    covariance: Array,
    sensors: int,
) -> ImmStates:
    """Return initial states of markers with known position and velocity.

    Args:
        motion: M models, all as likely.
        settings: deviation of the acceleration at the start.
        mean: positions and velocities, shape (N, 6).
        covariance: of these, shape (N, 6, 6).
        sensors: how many there are; what is given owes nothing to their constant errors.
    """
    count, models = len(mean), len(motion)
    states = ImmStates.zeros(count, sensors, models)
    states.mean[..., :_MOVING] = mean[:, None]
    states.covariance[..., :_MOVING, :_MOVING] = covariance[:, None]
    variance = settings.start_acceleration_mm_s2**2
    for model, has in enumerate(motion.has_acceleration):
        if has:
            states.covariance[:, model, _ACCELERATIONS, _ACCELERATIONS] = variance
    states.probability[:] = 1.0 / models
    return states


def filter_sequence(
    model: MeasurementModel,
    motion: MotionModels,
    settings: TrackerSettings,
    sequence: PointSequence,
) -> tuple[ImmStates, Array] | None:
    """Filter a sequence of points into the state of a new track.

    Args:
        model: the measurement model, of S sensors.
        motion: M motion models.
        settings: start values, detection probability and clutter density.
        sequence: the points, the earliest first.

    Returns:
        The state at the last point and the covariance (1, S, S) [px^2] of the readings' constant
        errors; None where a point does not fit the motion of a marker.
    """
    points, times = sequence.points, sequence.time_ns
    states, bias = states_from_points(
        model, motion, settings, points.position_mm[:1], points.sigma_px[:1]
    )
    used = points.choice >= 0
    for at in range(1, len(times)):
        step = np.array([(times[at] - times[at - 1]) * 1e-9])
        update = update_with_points(
            model,
            settings,
            mix_and_predict(motion, states, step),
            bias,
            points.position_px[at : at + 1],
            np.where(used[at : at + 1], points.sigma_px[at : at + 1], 1.0) ** 2,
            points.position_mm[at : at + 1],
        )
        if float(update.nis[0]) > chi2_limit(int(used[at].sum()), REPLAY_EXCLUSION_PROBABILITY):
            return None
        states = update.states
    return states, bias


def check_prior(position_mm: Array, velocity_mm_s: Array, covariance: Array) -> tuple[Array, Array]:
    """Check known positions and velocities of N markers.

    Args:
        position_mm: shape (N, 3) [mm].
        velocity_mm_s: shape (N, 3) [mm/s].
        covariance: of position and velocity, shape (N, 6, 6), or (6, 6) for all alike.

    Returns:
        Positions with velocities, shape (N, 6), and their covariance, shape (N, 6, 6).

    Raises:
        InvalidParameter: other shapes, a value that is not finite, or a covariance that is not
            symmetric and positive definite.
    """
    position = np.asarray(position_mm, dtype=np.float64)
    velocity = np.asarray(velocity_mm_s, dtype=np.float64)
    matrices = np.asarray(covariance, dtype=np.float64)
    if position.ndim != 2 or position.shape[1] != 3:
        raise InvalidParameter(f"position_mm has the shape {position.shape}; it must be (N, 3)")
    if velocity.shape != position.shape:
        raise InvalidParameter(
            f"velocity_mm_s has the shape {velocity.shape}; it must be {position.shape}"
        )
    each = (len(position), _MOVING, _MOVING)
    if matrices.shape not in (each, each[1:]):
        raise InvalidParameter(
            f"covariance has the shape {matrices.shape}; it must be {each} or {each[1:]}, of "
            "position and velocity"
        )
    matrices = np.broadcast_to(matrices, each)
    mean = np.concatenate([position, velocity], axis=1)
    for marker, (state, matrix) in enumerate(zip(mean, matrices, strict=True)):
        _check_prior(marker, state, matrix)
    return mean, matrices.copy()


def _check_prior(marker: int, mean: Array, covariance: Array) -> None:
    if not np.isfinite(mean).all():
        raise InvalidParameter(
            f"marker {marker} is at {mean[:3].tolist()} mm with {mean[3:].tolist()} mm/s; all must "
            "be finite"
        )
    if not np.isfinite(covariance).all():
        raise InvalidParameter(f"covariance of marker {marker} is not finite")
    off = np.abs(covariance - covariance.T).max()
    if off > _ASYMMETRY_TOLERANCE * np.abs(covariance).max():
        raise InvalidParameter(
            f"covariance of marker {marker} is off its transpose by {off:.3g}; it must be symmetric"
        )
    least = float(np.linalg.eigvalsh(covariance)[0])
    if not least > 0.0:
        raise InvalidParameter(
            f"covariance of marker {marker} has the eigenvalue {least:.3g}; all must be above 0"
        )
