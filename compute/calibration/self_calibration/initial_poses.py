"""Initial poses: markers triangulated with the current cameras, and targets fitted to them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.target_shape import TargetShape
from compute.calibration.self_calibration.targets import (
    CalibrationTarget,
    Recording,
    RigidBody,
    Wand,
)
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import TooFewPoints
from compute.reconstruction.triangulation import reconstruct, triangulate_linear
from compute.transform import nearest_rotation

Array = NDArray[np.float64]

PROCRUSTES_ITERATIONS = 20
DISTANCE_RATIO = 1.5
"""Largest ratio of a pose's distance to the median one, either way, with untrusted cameras."""


def triangulate(cameras: CameraStack, readings_px: Array) -> Array:
    """Triangulate markers, by the weighted solution or, where that fails, the linear one.

    Cameras with large errors give planes that intersect badly; a marker must lie in front of every
    lens that read it.

    Args:
        cameras: S cameras.
        readings_px: shape (..., S) [px]; NaN where not seen.

    Returns:
        Positions, shape (..., 3) [mm]; NaN where there is none.
    """
    flat = readings_px.reshape(-1, readings_px.shape[-1])
    found = reconstruct(cameras, flat, np.ones(flat.shape[1]), reliability=False).position_mm
    lines = triangulate_linear(cameras, flat)
    found = np.where(np.isfinite(found), found, lines)
    behind = np.isfinite(flat) & ~np.isfinite(cameras.project(np.nan_to_num(found)))
    found[behind.any(axis=1)] = np.nan
    return found.reshape(*readings_px.shape[:-1], 3)


@dataclass(frozen=True, eq=False)
class InitialPoses:
    """Starting poses of a recording, where its poses have one.

    Args:
        poses: the poses.
        pose_index: their indices in the recording, shape (B',).
    """

    poses: PoseSet
    pose_index: NDArray[np.intp]

    def select(self, which: NDArray[np.bool_]) -> "InitialPoses":
        """Return some of the poses, by a mask (B',)."""
        return InitialPoses(self.poses.select(which), self.pose_index[which])


def start_poses(
    models: Sequence[SensorModel],
    recording: Recording,
    sigma_px: Array,
    *,
    trusted: bool = True,
) -> InitialPoses:
    """Fit the target to its triangulated markers at every pose with enough of them.

    Args:
        models: approximate cameras.
        recording: the readings; NaN where not seen or rejected.
        sigma_px: standard deviations, shape (B, K, S) [px].
        trusted: False: the cameras' angles may be wrong by degrees, which shifts triangulated
            markers by metres along the line of sight. The known lengths then set the distance, and
            all poses start at about the same one.

    Raises:
        TooFewPoints: no pose shows enough markers.
    """
    cameras = CameraStack.of(models)
    marker = triangulate(cameras, recording.readings_px)
    shape = _shape(recording.target, marker)
    if not trusted:
        marker = _limit_distances(models, marker, _scale(shape, marker))
    fit = np.isfinite(marker[..., 0]).sum(axis=1) >= (3 if len(shape.rotation_axes) == 3 else 2)
    if fit.any():
        rotation, translation = fit_poses(shape, marker[fit])
        poses = PoseSet(shape, translation, rotation, recording.readings_px[fit], sigma_px[fit])
        # Fitted to the shape, a marker may have come to lie behind a lens.
        projected = cameras.project(poses.marker_positions().reshape(-1, 3))
        ahead = np.isfinite(projected).reshape(poses.readings_px.shape) | ~poses.observed_mask
        good = ahead.all(axis=(1, 2)) & (poses.observed_mask.sum(axis=(1, 2)) >= poses.unknowns)
        if good.any():
            return InitialPoses(poses, np.flatnonzero(fit)).select(good)
    raise TooFewPoints(
        f"none of the {len(marker)} poses shows enough markers to enough sensors: a marker "
        "needs three sensors, a wand two markers, a rigid body three",
        poses=len(marker),
    )


def observed_scale(models: Sequence[SensorModel], recording: Recording) -> float:
    """Return the median of lengths as the cameras see them over the known ones.

    Args:
        models: S cameras.
        recording: the readings.

    Returns:
        The ratio; NaN without any length.
    """
    marker = triangulate(CameraStack.of(models), recording.readings_px)
    return _scale(_shape(recording.target, marker), marker)


def _limit_distances(models: Sequence[SensorModel], marker_mm: Array, scale: float) -> Array:
    """Return markers at distances that agree with the known lengths, from the lenses' centre."""
    if not np.isfinite(scale):
        return marker_mm
    lenses = [
        -model.offset_x_mm * model.rotation[0] - model.offset_z_mm * model.rotation[2]
        for model in models
    ]
    centre = np.mean(lenses, axis=0)
    away = marker_mm - centre
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    usual = float(np.nanmedian(distance))
    kept = np.clip(distance, usual / DISTANCE_RATIO, usual * DISTANCE_RATIO)
    return np.asarray(centre + away * (kept / (distance * scale)))


def _shape(target: CalibrationTarget, marker_mm: Array) -> TargetShape:
    if isinstance(target, Wand | RigidBody):
        return target.shape()
    complete = marker_mm[np.isfinite(marker_mm).all(axis=(1, 2))]
    if len(complete) == 0:
        raise TooFewPoints(
            f"no pose shows all {len(target)} markers of the body of unknown shape to three "
            "sensors each; its first estimate needs one that does",
            markers=len(target),
        )
    centred = complete - complete.mean(axis=1, keepdims=True)
    known = target.distance
    length = np.linalg.norm(centred[:, known.first] - centred[:, known.second], axis=1)
    # Generalised Procrustes: rotate all to their mean, iteratively; the median pose first.
    size = np.sqrt((centred**2).sum(axis=(1, 2)))
    mean = centred[np.argsort(size, kind="stable")[len(size) // 2]]
    for _ in range(PROCRUSTES_ITERATIONS):
        rotations = _rotations(mean, centred)
        mean = np.median(np.einsum("bji,bkj->bki", rotations, centred), axis=0)
    return target.shape(mean * (known.length_mm / float(np.median(length))))


def marker_distances(marker_mm: Array) -> Array:
    """Return the distances between all pairs of markers (..., K, 3), shape (..., pairs) [mm]."""
    first, second = np.triu_indices(marker_mm.shape[-2], 1)
    return np.asarray(np.linalg.norm(marker_mm[..., first, :] - marker_mm[..., second, :], axis=-1))


def _scale(shape: TargetShape, marker_mm: Array) -> float:
    if shape.distances and not np.isfinite(shape.sigma_mm):
        # The shape came from the same markers: only the known distance says something.
        ends = np.array([(known.first, known.second) for known in shape.distances])
        known_length = np.array([known.length_mm for known in shape.distances])
        between = marker_mm[:, ends[:, 0]] - marker_mm[:, ends[:, 1]]
        ratio = np.linalg.norm(between, axis=2) / known_length
    else:
        ratio = marker_distances(marker_mm) / marker_distances(shape.marker_mm)
    return float(np.median(ratio[np.isfinite(ratio)])) if np.isfinite(ratio).any() else np.nan


def fit_poses(shape: TargetShape, marker_mm: Array) -> tuple[Array, Array]:
    """Fit poses to markers.

    Args:
        shape: the target.
        marker_mm: shape (B, K, 3) [mm]; NaN where missing.

    Returns:
        Rotations (B, 3, 3) and translations (B, 3) [mm].
    """
    known = np.isfinite(marker_mm[..., :1])
    count = known.sum(axis=1)
    seen = np.where(known, marker_mm, 0.0)
    centre = seen.sum(axis=1) / count
    own = np.where(known, shape.marker_mm, 0.0)
    own_centre = own.sum(axis=1) / count
    away = np.where(known, marker_mm - centre[:, None], 0.0)
    own = np.where(known, own - own_centre[:, None], 0.0)
    rotation = _rotations(own, away)
    return rotation, centre - np.einsum("bij,bj->bi", rotation, own_centre)


def _rotations(own: Array, seen: Array) -> Array:
    """Return R (B, 3, 3) with ``seen = R own`` in the least-squares sense (Kabsch)."""
    cross = np.einsum("bki,...kj->bij" if own.ndim == 2 else "bki,bkj->bij", seen, own)
    return nearest_rotation(cross)
