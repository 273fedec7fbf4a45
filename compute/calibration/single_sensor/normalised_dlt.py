"""Normalised direct linear transformation of one sensor: 2x4 matrix from control points."""

import numpy as np
from numpy.typing import NDArray

from compute.errors import DegeneratePoints

Array = NDArray[np.float64]

RANK_LIMIT = 1e-9
"""Smallest seventh singular value of the design, relative to the first."""


def normalisation(points_mm: Array) -> Array:
    """Return the 4x4 similarity that moves points (N, 3) to their centroid, RMS distance sqrt 3.

    Hartley's normalisation, doi:10.1109/34.601246.
    """
    centre = points_mm.mean(axis=0)
    scale = np.sqrt(3.0) / np.sqrt(((points_mm - centre) ** 2).sum(axis=1).mean())
    transform: Array = np.eye(4) * scale
    transform[:3, 3] = -scale * centre
    transform[3, 3] = 1.0
    return transform


def dlt_matrix(points_mm: Array, readings_px: Array, sensor: str) -> Array:
    """Solve ``p (m2.X~) = m1.X~`` for the 2x4 matrix in the algebraic least-squares sense.

    Equation [5.5] of the thesis without fixing the constant of the denominator to 1, with
    normalised points and readings, by singular values.

    Args:
        points_mm: control points that the sensor saw, shape (N, 3), N >= 7.
        readings_px: its readings, shape (N,) [px].
        sensor: the sensor's name, for the error.

    Raises:
        DegeneratePoints: the design's rank is below 7: more than one camera fits.
    """
    transform = normalisation(points_mm)
    homogeneous = np.column_stack([points_mm, np.ones(len(points_mm))]) @ transform.T
    middle = float(readings_px.mean())
    scale = float(readings_px.std()) or 1.0
    q = (readings_px - middle) / scale
    design = np.hstack([homogeneous, -q[:, None] * homogeneous])
    _, singular, right = np.linalg.svd(design, full_matrices=True)
    if singular[6] < RANK_LIMIT * singular[0]:
        raise DegeneratePoints(
            f"the control points and readings of sensor {sensor} determine only "
            f"{int((singular > RANK_LIMIT * singular[0]).sum())} of 7 parameters; spread the "
            "points in all three directions and across the sensor",
            sensor=sensor,
        )
    first, second = right[-1, :4], right[-1, 4:]
    matrix: Array = np.array([scale * first + middle * second, second]) @ transform
    return matrix
