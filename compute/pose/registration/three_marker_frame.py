"""Coordinate frame of three markers (section 7.2.3 of the thesis, Figure 7.6)."""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from compute.errors import (
    CollinearPoints,
    DuplicatePoint,
    InvalidParameter,
    NonFiniteValue,
    UndeterminedParameters,
)
from compute.transform import Transform, cross_matrix

Array = NDArray[np.float64]

MIN_HEIGHT: Final = 0.02
"""Smallest height of the markers' triangle over its longest side."""

MAX_ROTATION_SIGMA_RAD: Final = 1.0 / 3.0
"""Largest standard deviation of the frame's rotation."""


def three_marker_frame(markers_mm: Array, covariance_mm2: Array | None = None) -> Transform:
    """Return T_world_frame of the frame that markers M1, M2, M3 define.

    The origin is M1, x along M1M2 (i of the thesis), z along i x j with j = M2M3. The thesis
    prints ``y = i x k``, which points away from M3 and makes x, y, z left-handed: (x, i x k, k)
    has the determinant -1, and no rotation takes it to XYZ. Here ``y = k x i``, its opposite, so
    that the frame is right-handed, and M3 has a positive y.

    Args:
        markers_mm: M1, M2, M3 in the world, shape (3, 3) [mm].
        covariance_mm2: of the markers, shape (3, 3, 3), independent, or of all nine coordinates
            together, shape (9, 9) [mm^2]; None: exact.

    Returns:
        The transform, its covariance that of the markers propagated to first order.

    Raises:
        DuplicatePoint: two markers are at one position.
        CollinearPoints: they lie on one line.
        UndeterminedParameters: they are too near one another for their noise.
        InvalidParameter: an array is of another shape.
        NonFiniteValue: a marker's coordinate is not finite.
    """
    markers = np.asarray(markers_mm, dtype=np.float64)
    if markers.shape != (3, 3):
        raise InvalidParameter(f"markers have shape {markers.shape}; a frame takes three, (3, 3)")
    if not np.isfinite(markers).all():
        raise NonFiniteValue(f"the markers are {markers.tolist()}; they must be finite")
    i, j = markers[1] - markers[0], markers[2] - markers[1]
    sides = {"M1 and M2": i, "M2 and M3": j, "M1 and M3": i + j}
    longest = max(float(np.linalg.norm(side)) for side in sides.values())
    for names, side in sides.items():
        if not np.linalg.norm(side) > 1e-9 * longest:
            raise DuplicatePoint(f"{names} are at one position; a frame takes three markers")
    k = np.cross(i, j)
    flat = float(np.linalg.norm(k)) / longest**2
    if flat < MIN_HEIGHT:
        raise CollinearPoints(
            f"the three markers lie within {flat * longest:.3g} mm of a line {longest:.4g} mm "
            f"long; they must be at least {MIN_HEIGHT * longest:.3g} mm off it, or the turn "
            "about it is not known",
            height_mm=flat * longest,
            length_mm=longest,
        )
    x, z = i / np.linalg.norm(i), k / np.linalg.norm(k)
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    if covariance_mm2 is None:
        return Transform(axes, markers[0])
    joint = np.asarray(covariance_mm2, dtype=np.float64)
    if joint.shape == (3, 3, 3):
        joint = block_diag(*joint)
    elif joint.shape != (9, 9):
        raise InvalidParameter(
            f"covariance_mm2 has shape {joint.shape}; it must be (3, 3, 3) or (9, 9)"
        )
    jacobian = _frame_jacobian(axes, i, j, k)
    covariance = jacobian @ joint @ jacobian.T
    _check_rotation_sigma(covariance[:3, :3], sides)
    return Transform(axes, markers[0], covariance)


def _check_rotation_sigma(covariance: Array, sides: dict[str, Array]) -> None:
    values, ways = np.linalg.eigh(covariance)
    rotation_sigma = float(np.sqrt(max(values[-1], 0.0)))
    if rotation_sigma <= MAX_ROTATION_SIGMA_RAD:
        return
    way = ", ".join(f"{one:.2f}" for one in ways[:, -1])
    apart = ", ".join(f"{names} {np.linalg.norm(side):.3g} mm" for names, side in sides.items())
    raise UndeterminedParameters(
        f"the markers are too near one another for how well they are known: {apart} apart, their "
        f"noise leaves the rotation about ({way}) open to {rotation_sigma:.2g} rad; it must be "
        f"within {MAX_ROTATION_SIGMA_RAD:.2g} rad: place them further apart, or measure better",
        turn_rad=rotation_sigma,
        max_rad=MAX_ROTATION_SIGMA_RAD,
    )


def _frame_jacobian(axes: Array, i: Array, j: Array, k: Array) -> Array:
    """Return d (rotation on the left, origin) / d (M1, M2, M3), shape (6, 9)."""
    eye = np.eye(3)
    d_i = np.concatenate([-eye, eye, np.zeros((3, 3))], axis=1)
    d_j = np.concatenate([np.zeros((3, 3)), -eye, eye], axis=1)
    d_k = cross_matrix(i) @ d_j - cross_matrix(j) @ d_i
    x, y, z = axes.T
    jacobian = np.zeros((6, 9))
    # dx = w x x, so w.z = dx.y and w.y = -dx.z; dz = w x z, so w.x = -dz.y.
    about_x = -(y @ d_k) / np.linalg.norm(k)
    about_y = -(z @ d_i) / np.linalg.norm(i)
    about_z = (y @ d_i) / np.linalg.norm(i)
    jacobian[:3] = np.outer(x, about_x) + np.outer(y, about_y) + np.outer(z, about_z)
    jacobian[3:, :3] = eye
    return jacobian
