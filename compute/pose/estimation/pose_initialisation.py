"""Starts of a pose fit: from reconstructed points, or from readings alone by all rotations."""

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_matrix
from compute.measurement.measurement_model import MeasurementModel
from compute.pose.centred_markers import CentredMarkers, are_collinear
from compute.pose.transform import cross_matrix, nearest_rotation

Array = NDArray[np.float64]

ROTATIONS: Final = 600
"""Over all turns; the nearest is 14 degrees away on average, 25 at most."""
ROTATIONS_REFINED: Final = 64
REFINEMENT_STEPS: Final = 12
MAX_STARTS: Final = 8
MIN_SEPARATION_RAD: Final = 0.05
"""Starts nearer to one another lead to the same solution."""
_SUPER_FIBONACCI_PSI: Final = 1.533751168755204288118041413
"""The root of psi^4 = psi + 4 (Alexa, 2022)."""


def initial_pose_from_points(
    markers_mm: Array, points_mm: Array, weights: Array | None = None
) -> tuple[Array, Array] | None:
    """Return the rotation (3, 3) and translation (3,) that lay markers on points best.

    W. Kabsch, doi:10.1107/S0567739476001873, with the determinant held at +1: a mirrored tool is
    no tool.

    Args:
        markers_mm: shape (N, 3) [mm].
        points_mm: shape (N, 3) [mm]; rows with NaN are left out.
        weights: shape (N,); None: equal.

    Returns:
        None with fewer than three points, or points on a line: they leave a turn open.
    """
    known = np.isfinite(points_mm).all(axis=1)
    if known.sum() < 3:
        return None
    source, target = markers_mm[known], points_mm[known]
    weight = np.ones(len(source)) if weights is None else weights[known]
    weight = weight / weight.sum()
    centre_source, centre_target = weight @ source, weight @ target
    about_source, about_target = source - centre_source, target - centre_target
    if are_collinear(source) or are_collinear(target):
        return None
    rotation = nearest_rotation((about_target * weight[:, None]).T @ about_source)
    return rotation, centre_target - rotation @ centre_source


def initial_poses_from_readings(
    model: MeasurementModel, centred: CentredMarkers, readings_px: Array, sigma_px: Array
) -> tuple[Array, Array]:
    """Return rotations (K, 3, 3) and centroids (K, 3) [mm] that fit readings, best first.

    Each reading is a plane (thesis, section 2.4): ``n . (R b + t) + d = 0``, so that for a
    rotation the best t is linear, and what remains is linear in the nine elements of R. It is
    worked out for rotations all over, the best of which are improved by Gauss-Newton. No marker
    needs three sensors.

    Args:
        model: the cameras.
        centred: the tool's markers.
        readings_px: raw readings, shape (M, S) [px]; NaN where nothing was seen.
        sigma_px: their standard deviations, shape (M, S) [px].

    Returns:
        K up to KEPT; 0 where the planes tell no place.
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
    # n residuals, c + A vec(R), have no more to say than the square root of the 10 x 10 matrix.
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
    """Return the point (3,) [mm] nearest to the planes of all readings (M, S); None: there is none.

    It is amid the markers, as if they were one.
    """
    planes = _planes(model, readings_px, sigma_px, np.isfinite(readings_px))
    return None if planes is None else planes[2]


def _planes(
    model: MeasurementModel, readings_px: Array, sigma_px: Array, used: NDArray[np.bool_]
) -> tuple[Array, Array, Array] | None:
    """Return the used readings' planes n, d, in standard deviations, and where the tool is."""
    cameras = model.cameras
    sensor = np.nonzero(used)[1]
    corrected = cameras.add_cubic_term(readings_px)
    slope = cameras.correction_derivative(readings_px)
    deviation = (sigma_px * slope)[used]
    weight = 1.0 / deviation
    shift = np.zeros(len(model))
    place: Array | None = None
    for _ in range(3):
        rows = (
            cameras.matrices[sensor, 0]
            - (corrected + shift)[used][:, None] * cameras.matrices[sensor, 1]
        )
        if place is not None:
            depth = cameras.matrices[sensor, 1] @ np.append(place, 1.0)
            weight = 1.0 / (deviation * np.maximum(np.abs(depth), 1e-3))
        rows = rows * weight[:, None]
        found, _, rank, _ = np.linalg.lstsq(rows[:, :3], -rows[:, 3])
        if rank < 3:
            return None
        place = found
        shift = _linearising_shift(model, place)
        if not np.isfinite(shift[np.unique(sensor)]).all():
            return None
        shift = np.nan_to_num(shift)
    assert place is not None
    return rows[:, :3], rows[:, 3], place


def _linearising_shift(model: MeasurementModel, place_mm: Array) -> Array:
    """Return what to add to readings of this neighbourhood to undo distortion and table, (S,)."""
    cameras = model.cameras
    shift = np.zeros(len(cameras))
    if cameras.has_distortion:
        plain = cameras.matrices @ np.append(place_mm, 1.0)
        shift = plain[:, 0] / plain[:, 1] - cameras.project(place_mm[None])[0]
    if model.corrections is not None:
        shift = shift + model.corrections.at(place_mm[None]).value_px[0]
    return shift


def _refine_rotations(rotations: Array, rest: Array, design: Array) -> tuple[Array, Array]:
    """Minimise |c + A vec(R)|^2 over turns of K rotations; return them and their squares."""
    by_element = design.reshape(-1, 3, 3)

    def residual(of: Array) -> Array:
        found: Array = rest + of.reshape(-1, 9) @ design.T
        return found

    value = residual(rotations)
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
        trial_value = residual(trial)
        trial_cost = (trial_value**2).sum(axis=1)
        better = trial_cost <= cost
        rotations = np.where(better[:, None, None], trial, rotations)
        value = np.where(better[:, None], trial_value, value)
        cost = np.where(better, trial_cost, cost)
        damping *= np.where(better, 0.2, 10.0)
    return rotations, cost


def _separated(rotations: Array, cost: Array) -> NDArray[np.intp]:
    """Return which rotations to keep, best first, none near a better one."""
    order = np.argsort(cost, kind="stable")
    near = 1.0 + 2.0 * np.cos(MIN_SEPARATION_RAD)
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    kept: list[int] = []
    for index in order:
        if all(traces[index, other] < near for other in kept):
            kept.append(int(index))
            if len(kept) == MAX_STARTS:
                break
    return np.array(kept, dtype=np.intp)


_AXES: Final = cross_matrix(np.eye(3))


@cache
def _all_rotations() -> Array:
    """Return ROTATIONS rotations spread over all turns, shape (ROTATIONS, 3, 3).

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
