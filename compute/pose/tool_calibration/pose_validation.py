"""Poses as arrays, checked: what pivot and spin calibration are given."""

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter, NonFiniteValue

Array = NDArray[np.float64]


def validate_poses(
    rotations: Array, translations_mm: Array, covariances: Array | None
) -> tuple[Array, Array, Array | None]:
    """Return the poses as float64.

    Args:
        rotations: R_world_tool, shape (N, 3, 3).
        translations_mm: shape (N, 3) [mm].
        covariances: of turn [rad] and translation [mm], as in ToolPose, shape (N, 6, 6); None:
            not known, and the same for all.

    Raises:
        InvalidParameter: shapes do not fit one another, or a matrix is no rotation.
        NonFiniteValue: a value is NaN or infinite.
    """
    rotations = np.asarray(rotations, dtype=np.float64)
    translations = np.asarray(translations_mm, dtype=np.float64)
    count = len(translations)
    pose_covariances = None if covariances is None else np.asarray(covariances, dtype=np.float64)
    for name, array, shape in (
        ("rotations", rotations, (count, 3, 3)),
        ("translations_mm", translations, (count, 3)),
        ("covariances", pose_covariances, (count, 6, 6)),
    ):
        if array is None:
            continue
        if array.shape != shape:
            raise InvalidParameter(f"{name} has shape {array.shape}; it must be {shape}")
        bad = ~np.isfinite(array.reshape(count, -1)).all(axis=1)
        if bad.any():
            raise NonFiniteValue(
                f"{name} of pose {int(np.argmax(bad))} is not finite; leave out poses that are "
                "not known",
                pose=int(np.argmax(bad)),
            )
    off = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).reshape(count, -1)
    bad = (off > 1e-6).any(axis=1) | (np.linalg.det(rotations) < 0.0)
    if bad.any():
        raise InvalidParameter(
            f"the matrix of pose {int(np.argmax(bad))} is no rotation", pose=int(np.argmax(bad))
        )
    if pose_covariances is not None and (np.linalg.eigvalsh(pose_covariances)[:, 0] <= 0.0).any():
        worst = int(np.argmin(np.linalg.eigvalsh(pose_covariances)[:, 0]))
        raise InvalidParameter(
            f"the covariance of pose {worst} is not positive definite", pose=worst
        )
    return rotations, translations, pose_covariances
