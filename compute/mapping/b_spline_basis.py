"""Uniform B-splines of degree 1 and 3 in one cell: weights of the coefficients and their slopes."""

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]


def b_spline_basis(cell_coordinate: Array, degree: int) -> tuple[Array, Array]:
    """Return the weights of the degree + 1 coefficients that reach into a cell.

    C. de Boor, A Practical Guide to Splines, chapter IX; the weights are 0 or more and add up
    to 1.

    Args:
        cell_coordinate: in the cell, from 0 to 1, any shape (...).
        degree: 1 or 3.

    Returns:
        Weights and their derivatives by the place, both of shape (..., degree + 1).

    Raises:
        InvalidParameter: another degree.
    """
    t = np.asarray(cell_coordinate, dtype=np.float64)
    if degree == 1:
        return np.stack([1.0 - t, t], axis=-1), np.stack([-np.ones_like(t), np.ones_like(t)], -1)
    if degree != 3:
        raise InvalidParameter(f"degree is {degree}; it must be 1 or 3")
    s = 1.0 - t
    weights = [s**3, 4.0 - 6.0 * t**2 + 3.0 * t**3, 4.0 - 6.0 * s**2 + 3.0 * s**3, t**3]
    derivatives = [-3.0 * s**2, 9.0 * t**2 - 12.0 * t, 12.0 * s - 9.0 * s**2, 3.0 * t**2]
    return np.stack(weights, axis=-1) / 6.0, np.stack(derivatives, axis=-1) / 6.0
