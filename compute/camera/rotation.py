"""Small rotations as vectors: batched exponential of so(3)."""

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
