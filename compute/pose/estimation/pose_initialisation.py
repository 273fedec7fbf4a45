"""Initial poses of a fit: from reconstructed points, or from readings by a search of SO(3)."""

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.rigid_body import CentredMarkers, are_collinear
from compute.transform import cross_matrix, nearest_rotation, rotation_matrix

Array = NDArray[np.float64]

ROTATIONS: Final = 600
"""Samples of SO(3): the nearest is 14 degrees away on average, 25 at most."""
ROTATIONS_REFINED: Final = 64
REFINEMENT_STEPS: Final = 12
MAX_STARTS: Final = 8
MIN_SEPARATION_RAD: Final = 0.05
"""Initial poses closer than this converge to the same solution."""
_SUPER_FIBONACCI_PSI: Final = 1.533751168755204288118041413
"""The root of psi^4 = psi + 4 (Alexa, 2022)."""


def initial_pose_from_points(markers_mm: Array, points_mm: Array) -> tuple[Array, Array] | None:
    """Return the rotation (3, 3) and translation (3,) of the best fit of markers to points.

    W. Kabsch, doi:10.1107/S0567739476001873, with the determinant held at +1: a reflection is not
    allowed.

    Args:
        markers_mm: shape (N, 3) [mm].
        points_mm: shape (N, 3) [mm]; rows with NaN are left out.

    Returns:
        None with fewer than three points, or collinear ones: they leave a rotation undetermined.
    """
    finite = np.isfinite(points_mm).all(axis=1)
    source, target = markers_mm[finite], points_mm[finite]
    if are_collinear(source) or are_collinear(target):
        return None
    weight = np.full(len(source), 1.0 / len(source))
    centre_source, centre_target = weight @ source, weight @ target
    about_source, about_target = source - centre_source, target - centre_target
    rotation = nearest_rotation((about_target * weight[:, None]).T @ about_source)
    return rotation, centre_target - rotation @ centre_source


def initial_poses_from_readings(
    model: MeasurementModel, centred: CentredMarkers, readings_px: Array, sigma_px: Array
) -> tuple[Array, Array]:
    """Return rotations (K, 3, 3) and centroids (K, 3) [mm] that fit readings, best first.

    Each reading is a plane (thesis, section 2.4): ``n . (R b + t) + d = 0``, so that for a given
    rotation the best t is linear, and the remaining residuals are linear in the nine elements of R.
    They are evaluated for rotations all over SO(3); Gauss-Newton refines the best. A marker may be
    seen by fewer than three sensors.

    Args:
        model: the cameras.
        centred: the tool's markers.
        readings_px: raw readings, shape (M, S) [px]; NaN where nothing was seen.
        sigma_px: their standard deviations, shape (M, S) [px].

    Returns:
        K up to MAX_STARTS; 0 where the planes determine no position.
    """
    used = np.isfinite(readings_px)
    planes = _planes(model, readings_px, sigma_px, used)
    if planes is None:
        return np.empty((0, 3, 3)), np.empty((0, 3))
    normals, offsets, _ = planes
    markers = centred.markers_mm[np.nonzero(used)[0]]
    inverse = np.linalg.pinv(normals)
    by_rotation = (normals[:, :, None] * markers[:, None, :]).reshape(-1, 9)
    rest = offsets - normals @ (inverse @ offsets)
    design = by_rotation - normals @ (inverse @ by_rotation)
    # The n residuals c + A vec(R) reduce to the R factor of a QR decomposition, 10 x 10.
    square: Array = np.asarray(np.linalg.qr(np.column_stack([design, rest])).R)
    design, rest = square[:, :9], square[:, 9]
    rotations = _all_rotations()
    cost = ((rest + rotations.reshape(-1, 9) @ design.T) ** 2).sum(axis=1)
    rotations = rotations[np.argsort(cost, kind="stable")[:ROTATIONS_REFINED]]
    rotations, cost = _refine_rotations(rotations, rest, design)
    rotations = rotations[_separated(rotations, cost)]
    vectors = rotations.reshape(-1, 9)
    return rotations, -(offsets + vectors @ by_rotation.T) @ inverse.T


def rough_position(model: MeasurementModel, readings_px: Array, sigma_px: Array) -> Array | None:
    """Return the point (3,) [mm] nearest to the planes of all readings; None: they determine none.

    All readings are treated as of one marker, so the point lies among the markers.

    Args:
        model: the cameras.
        readings_px: raw readings, shape (M, S) [px]; NaN where nothing was seen.
        sigma_px: their standard deviations, shape (M, S) [px].
    """
    planes = _planes(model, readings_px, sigma_px, np.isfinite(readings_px))
    return None if planes is None else planes[2]


def _planes(
    model: MeasurementModel, readings_px: Array, sigma_px: Array, used: NDArray[np.bool_]
) -> tuple[Array, Array, Array] | None:
    """Return the readings' planes n, d in standard deviations, and the tool's rough position."""
    cameras = model.cameras
    sensor = np.nonzero(used)[1]
    corrected = cameras.add_cubic_term(readings_px)
    derivative = cameras.correction_derivative(readings_px)
    sigma = (sigma_px * derivative)[used]
    weight = 1.0 / sigma
    shift = np.zeros(len(model))
    position_mm: Array | None = None
    for _ in range(3):
        rows = (
            cameras.matrices[sensor, 0]
            - (corrected + shift)[used][:, None] * cameras.matrices[sensor, 1]
        )
        if position_mm is not None:
            depth = cameras.matrices[sensor, 1] @ np.append(position_mm, 1.0)
            weight = 1.0 / (sigma * np.maximum(np.abs(depth), 1e-3))
        rows = rows * weight[:, None]
        solution, _, rank, _ = np.linalg.lstsq(rows[:, :3], -rows[:, 3])
        if rank < 3:
            return None
        position_mm = solution
        shift = _linearising_shift(model, position_mm)
        if not np.isfinite(shift[np.unique(sensor)]).all():
            return None
        shift = np.nan_to_num(shift)
    assert position_mm is not None
    return rows[:, :3], rows[:, 3], position_mm


def _linearising_shift(model: MeasurementModel, position_mm: Array) -> Array:
    """Return the shift of readings near a position that undoes distortion and table, (S,) [px]."""
    cameras = model.cameras
    shift = np.zeros(len(cameras))
    if cameras.has_distortion:
        plain = cameras.matrices @ np.append(position_mm, 1.0)
        shift = plain[:, 0] / plain[:, 1] - cameras.project(position_mm[None])[0]
    if model.corrections is not None:
        shift = shift + model.corrections.at(position_mm[None]).value_px[0]
    return shift


def _refine_rotations(rotations: Array, rest: Array, design: Array) -> tuple[Array, Array]:
    """Minimise |c + A vec(R)|^2 from K rotations; return rotations and sums of squares."""
    by_element = design.reshape(-1, 3, 3)
    value = rest + rotations.reshape(-1, 9) @ design.T
    cost = (value**2).sum(axis=1)
    damping = np.full(len(rotations), 1e-3)
    for _ in range(REFINEMENT_STEPS):
        # d R = [w]x R: along each axis, [e]x R.
        turned = _AXES @ rotations[:, None]
        jacobian = np.einsum("nij,kaij->kna", by_element, turned)
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        diagonal = np.einsum("kii->ki", normal)
        diagonal += damping[:, None] * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True)
        gradient = np.einsum("kna,kn->ka", jacobian, value)
        step = -np.linalg.solve(normal, gradient[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, 0.5 / np.maximum(length, 1e-12))
        trial = rotation_matrix(step) @ rotations
        trial_value = rest + trial.reshape(-1, 9) @ design.T
        trial_cost = (trial_value**2).sum(axis=1)
        better = trial_cost <= cost
        rotations = np.where(better[:, None, None], trial, rotations)
        value = np.where(better[:, None], trial_value, value)
        cost = np.where(better, trial_cost, cost)
        damping *= np.where(better, 0.2, 10.0)
    return rotations, cost


def _separated(rotations: Array, cost: Array) -> NDArray[np.intp]:
    """Return indices of the rotations to keep, best first, none close to a better one."""
    near = 1.0 + 2.0 * np.cos(MIN_SEPARATION_RAD)
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    separated: list[int] = []
    for index in np.argsort(cost, kind="stable"):
        if (traces[index, separated] < near).all():
            separated.append(int(index))
    return np.array(separated[:MAX_STARTS], dtype=np.intp)


_AXES: Final = cross_matrix(np.eye(3))


@cache
def _all_rotations() -> Array:
    """Return ROTATIONS rotations spread evenly over SO(3), shape (ROTATIONS, 3, 3).

    Super-Fibonacci spirals (M. Alexa, doi:10.1109/CVPR52688.2022.00811).
    """
    s = np.arange(ROTATIONS) + 0.5
    inner, outer = np.sqrt(s / ROTATIONS), np.sqrt(1.0 - s / ROTATIONS)
    alpha = 2.0 * np.pi * s / np.sqrt(2.0)
    beta = 2.0 * np.pi * s / _SUPER_FIBONACCI_PSI
    x, y = inner * np.sin(alpha), inner * np.cos(alpha)
    z, w = outer * np.sin(beta), outer * np.cos(beta)
    vector = np.stack([x, y, z], axis=1)
    sine = np.linalg.norm(vector, axis=1)
    angle = 2.0 * np.arctan2(sine, w)
    return rotation_matrix(vector / sine[:, None] * angle[:, None])
