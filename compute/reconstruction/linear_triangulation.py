"""Linear triangulation: least-squares intersection of the readings' planes."""

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

CONDITION_LIMIT = 1e-10
"""Smallest ratio of singular values at which three planes still count as meeting in a point."""


def triangulate_linear(
    cameras: CameraStack, corrected_px: Array, weights: Array | None = None
) -> Array:
    """Intersect the planes of corrected readings; thesis [5.13]-[5.15], [5.22]-[5.24].

    Each reading q gives one plane ``(m1 - q m2).X~ = 0``. With the metric matrices this is
    [5.22]; the thesis's DLT form [5.13] differs by a factor for each sensor.

    Args:
        cameras: S cameras.
        corrected_px: readings after ``cameras.corrected``, shape (N, S); NaN where not seen.
        weights: factors for the equations, shape (N, S); None: all 1, as in the thesis.

    Returns:
        Points, shape (N, 3) [mm]; NaN where fewer than three sensors saw the point or where
        the planes meet in a line.
    """
    matrices = cameras.matrices
    seen = np.isfinite(corrected_px)
    q = np.where(seen, corrected_px, 0.0)
    rows = matrices[:, 0] - q[..., None] * matrices[:, 1]
    rows = rows * (seen if weights is None else seen * weights)[..., None]
    points = np.full((len(rows), 3), np.nan)
    enough = seen.sum(axis=1) >= 3
    if not enough.any():
        return points
    # QR instead of the normal equations (A'A)^-1 of [5.15]: the same solution, without squaring
    # the condition number.
    q_factor, r_factor = np.linalg.qr(rows[enough, :, :3])
    singular = np.linalg.svd(r_factor, compute_uv=False)
    good = singular[:, 2] > CONDITION_LIMIT * singular[:, 0]
    right = -np.einsum("nsi,ns->ni", q_factor, rows[enough, :, 3])
    solved = np.full((len(right), 3), np.nan)
    solved[good] = np.linalg.solve(r_factor[good], right[good, :, None])[..., 0]
    points[enough] = solved
    return points
