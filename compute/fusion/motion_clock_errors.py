"""Covariance of tracks and tool poses by the errors of the bars' clocks.

A filter takes the readings of a bar whose clock is off by ``d`` for those of now. Once the motion
has settled, the state is off by ``-W v d``: ``v`` is the velocity and ``W`` the share of the bar in
the information of all, ``(sum I)^-1 I_bar``.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.rigid_body import PoseStatus, RigidBody, ToolPose
from compute.tracking.track_batch import TrackBatch
from compute.transform import hat_so3

Array = NDArray[np.float64]


def add_clock_errors_to_tracks(
    tracks: TrackBatch,
    model: MeasurementModel,
    bar_of_sensor: NDArray[np.intp],
    covariance_s2: Array,
) -> TrackBatch:
    """Return tracks with the clocks' share in the covariances of their positions.

    Args:
        tracks: T tracks after one exposure.
        model: the cameras.
        bar_of_sensor: number of each sensor's bar, shape (S,); -1: of the reference's.
        covariance_s2: of the clock errors of B bars, shape (B, B) [s^2].
    """
    if not len(tracks) or not covariance_s2.any():
        return tracks
    predicted = model.predict(tracks.position_mm)
    jacobian = np.where(predicted.in_view[..., None], predicted.jacobian_px_per_mm, 0.0)
    share = _shares(jacobian[:, :, None], bar_of_sensor, len(covariance_s2))
    shift = -np.einsum("tbij,tj->tib", share, tracks.velocity_mm_s)
    covariance = tracks.covariance.copy()
    covariance[:, :3, :3] += shift @ covariance_s2 @ shift.swapaxes(1, 2)
    return replace(tracks, covariance=covariance)


def add_clock_errors_to_pose(
    pose: ToolPose,
    tool: RigidBody,
    model: MeasurementModel,
    bar_of_sensor: NDArray[np.intp],
    covariance_s2: Array,
    max_tip_sd_mm: float,
) -> ToolPose:
    """Return a pose with the clocks' share in its covariances; HIGH_ERROR beyond the tip's limit.

    Args:
        pose: of the tool.
        tool: its markers and tip.
        model: the cameras.
        bar_of_sensor: number of each sensor's bar, shape (S,); -1: of the reference's.
        covariance_s2: of the clock errors of B bars, shape (B, B) [s^2].
        max_tip_sd_mm: 3D standard deviation of the tip above which a pose is HIGH_ERROR, for tools
            without a limit of their own [mm].
    """
    rotation, origin = pose.rotation, pose.translation_mm
    velocity, turning = pose.velocity_mm_s, pose.angular_velocity_rad_s
    if (
        rotation is None
        or origin is None
        or velocity is None
        or turning is None
        or pose.covariance is None
        or not covariance_s2.any()
    ):
        return pose
    arms = np.asarray(tool.markers_mm) @ rotation.T
    predicted = model.predict(arms + origin)
    # d reading / d (rotation, origin): by marker and sensor.
    jacobian = predicted.jacobian_px_per_mm
    of_pose = np.concatenate([np.cross(arms[:, None], jacobian), jacobian], axis=2)
    of_pose = np.where(predicted.in_view[..., None], of_pose, 0.0)
    share = _shares(of_pose.swapaxes(0, 1)[None], bar_of_sensor, len(covariance_s2))[0]
    shift = -share @ np.concatenate([turning, velocity])
    added = shift.T @ covariance_s2 @ shift
    tip_covariance, status, reason = pose.tip_covariance_mm2, pose.status, pose.reason
    if tip_covariance is not None:
        tip = np.zeros(3) if tool.tip_mm is None else np.array(tool.tip_mm)
        of_tip = np.concatenate([-hat_so3(rotation @ tip), np.eye(3)], axis=1)
        tip_covariance = tip_covariance + of_tip @ added @ of_tip.T
        tip_sd = float(np.sqrt(np.trace(tip_covariance)))
        limit = max_tip_sd_mm if tool.max_tip_sd_mm is None else tool.max_tip_sd_mm
        if tip_sd > limit and status is not PoseStatus.HIGH_ERROR:
            status = PoseStatus.HIGH_ERROR
            reason = (
                f"the tip's standard deviation is {tip_sd:.3g} mm, with what the bars' clocks may "
                f"be off at this speed; at most {limit:.3g} mm is allowed"
            )
    return replace(
        pose,
        status=status,
        reason=reason,
        covariance=pose.covariance + added,
        tip_covariance_mm2=tip_covariance,
    )


def _shares(jacobian: Array, bar_of_sensor: NDArray[np.intp], bars: int) -> Array:
    """Return each bar's share in the information of all sensors, shape (N, B, D, D).

    Args:
        jacobian: of M readings of each sensor by D parameters, shape (N, S, M, D).
        bar_of_sensor: number of each sensor's bar, shape (S,).
        bars: B.
    """
    by_sensor = np.einsum("nsmi,nsmj->nsij", jacobian, jacobian)
    member = (bar_of_sensor == np.arange(bars)[:, None]).astype(np.float64)
    by_bar = np.einsum("bs,nsij->nbij", member, by_sensor)
    # Parameters that nothing tells of, as a rotation about a line of markers, have no share.
    inverse = np.linalg.pinv(by_sensor.sum(axis=1), rcond=1e-12, hermitian=True)
    shares: Array = inverse[:, None] @ by_bar
    return shares
