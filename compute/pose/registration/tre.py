"""Target registration error: how far off a registered target is, from how far off fiducials are."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def target_registration_error(fiducials_mm: Array, targets_mm: Array, fle_mm: float) -> Array:
    """Return the RMS error to expect at targets, shape (T,) [mm].

    ``TRE^2 = FLE^2 / N (1 + 1/3 sum_k d_k^2 / f_k^2)`` with d_k the target's distance from the
    k-th principal axis of the N fiducials, and f_k their RMS distance from it
    (J. M. Fitzpatrick, J. B. West, C. R. Maurer, doi:10.1109/42.736021). For errors that are the
    same for all fiducials and in all directions, and without scale.

    Args:
        fiducials_mm: shape (N, 3) [mm].
        targets_mm: shape (T, 3) [mm], in the same frame.
        fle_mm: RMS error of a fiducial in space [mm], of both frames together.
    """
    centre = fiducials_mm.mean(axis=0)
    _, _, axes = np.linalg.svd(fiducials_mm - centre)

    def distances(points: Array) -> Array:
        along = (points - centre) @ axes.T
        found: Array = (along**2).sum(axis=1, keepdims=True) - along**2
        return found

    ratio = (distances(targets_mm) / distances(fiducials_mm).mean(axis=0)).sum(axis=1)
    error: Array = fle_mm * np.sqrt((1.0 + ratio / 3.0) / len(fiducials_mm))
    return error


def fiducial_localisation_error(residuals_mm: Array, parameters: int = 6) -> float:
    """Return the fiducial localisation error (RMS in space) that N residuals tell of [mm].

    ``FLE^2 = N / (N - 2) FRE^2`` (R. Sibson, doi:10.1111/j.2517-6161.1979.tb01076.x): a rigid
    motion takes up six of the 3 N degrees of freedom, a similarity seven.

    Args:
        residuals_mm: shape (N, 3) [mm].
        parameters: of the motion.
    """
    dof = residuals_mm.size - parameters
    return float(np.sqrt(3.0 * (residuals_mm**2).sum() / dof))
