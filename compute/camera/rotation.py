"""Rotations as vectors and matrices: of arrays, and faster (exp_so3, hat_so3) of one vector."""

from math import sin, sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL_RAD = 1e-4


def rotation_matrix(vector_rad: Array) -> Array:
    """Return exp([w]x) of rotation vectors (..., 3) [rad], shape (..., 3, 3) (Rodrigues)."""
    w = np.asarray(vector_rad, dtype=np.float64)
    square = (w**2).sum(axis=-1)
    angle = np.sqrt(square)
    small = angle < _SMALL_RAD
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - square / 6.0, np.sin(safe) / safe)
    half = np.sin(0.5 * safe) / safe
    second = np.where(small, 0.5 - square / 24.0, 2.0 * half**2)
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    # I + a [w]x + b [w]x^2 with [w]x^2 = w w' - |w|^2 I.
    matrix = second[..., None, None] * (w[..., :, None] * w[..., None, :])
    diagonal = 1.0 - second * square
    for axis in range(3):
        matrix[..., axis, axis] += diagonal
    matrix[..., 0, 1] -= first * z
    matrix[..., 1, 0] += first * z
    matrix[..., 0, 2] += first * y
    matrix[..., 2, 0] -= first * y
    matrix[..., 1, 2] -= first * x
    matrix[..., 2, 1] += first * x
    return matrix


def rotation_vector(matrix: Array) -> Array:
    """Return the axis times angle [rad] of rotation matrices (..., 3, 3), shape (..., 3).

    It loses no digits at any angle.
    """
    quaternion = rotation_quaternion(matrix)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quaternion[..., :1])
    small = sine < 1e-12
    vector: Array = quaternion[..., 1:] * np.where(small, 2.0, angle / np.where(small, 1.0, sine))
    return vector


def rotation_quaternion(matrix: Array) -> Array:
    """Return the unit quaternions of rotation matrices (..., 3, 3), shape (..., 4).

    Scalar first, and not negative. By the largest component (S. W. Shepperd,
    doi:10.2514/3.55767b), which loses no digits at any angle.
    """
    m = np.asarray(matrix, dtype=np.float64)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    # 4 q q', from the sums and differences of the elements.
    outer = np.empty((*m.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1.0 + trace
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        outer[..., axis + 1, axis + 1] = 1.0 + 2.0 * m[..., axis, axis] - trace
        turned = m[..., second, first] - m[..., first, second]
        outer[..., 0, axis + 1] = outer[..., axis + 1, 0] = turned
        swept = m[..., first, second] + m[..., second, first]
        outer[..., first + 1, second + 1] = outer[..., second + 1, first + 1] = swept
    largest = np.argmax(np.einsum("...ii->...i", outer), axis=-1)
    quaternion = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    upper: Array = quaternion * np.where(quaternion[..., :1] < 0.0, -1.0, 1.0)
    return upper


def exp_so3(vector_rad: Array) -> Array:
    """Return exp([w]x) of one rotation vector (3,) [rad], shape (3, 3), as rotation_matrix does."""
    x, y, z = vector_rad.tolist()
    square = x * x + y * y + z * z
    angle = sqrt(square)
    if angle < _SMALL_RAD:
        first, second = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        half = sin(0.5 * angle) / angle
        first, second = sin(angle) / angle, 2.0 * half * half
    diagonal = 1.0 - second * square
    sx, sy, sz = second * x, second * y, second * z
    xy, xz, yz = sx * y, sx * z, sy * z
    fx, fy, fz = first * x, first * y, first * z
    return np.array(
        [
            [diagonal + sx * x, xy - fz, xz + fy],
            [xy + fz, diagonal + sy * y, yz - fx],
            [xz - fy, yz + fx, diagonal + sz * z],
        ]
    )


def hat_so3(vector: Array) -> Array:
    """Return [v]x of one vector (3,), shape (3, 3)."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
