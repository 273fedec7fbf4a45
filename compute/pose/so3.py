"""Small: single 3-vectors and matrices without the overhead of functions for many at once.

A filter's step on one tool is some fifty operations on arrays of a dozen numbers: what they cost is
the calls, not the numbers.
"""

from math import sin, sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL_RAD = 1e-4


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
