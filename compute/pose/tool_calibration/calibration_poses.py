"""Poses for pivot and spin calibration: validation, and the spread of their orientations."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_vector
from compute.errors import InvalidParameter, NonFiniteValue

Array = NDArray[np.float64]

_PAIRS = 400


@dataclass(frozen=True, eq=False)
class OrientationCoverage:
    """Spread of a tool's orientations.

    A direction u of the tool points along R_i u. With M the mean of the R_i, the variance of
    these is ``1 - |M u|^2``: the sine squared of the RMS angle by which the direction swung. The
    singular vectors of M are the directions that swung least and most. Rotations about a single
    axis leave that axis fixed.

    Args:
        axes: three perpendicular directions in the tool, the one that swung least first; a row
            each, shape (3, 3).
        swing_rad: RMS angle by which each swung about its mean, shape (3,) [rad].
        range_rad: largest angle between two orientations [rad] (among at most 400, evenly
            spaced).
    """

    axes: Array
    swing_rad: Array
    range_rad: float

    @classmethod
    def of(cls, rotations: Array) -> Self:
        """Return the spread of N orientations R_world_tool (N, 3, 3)."""
        _, values, axes = np.linalg.svd(rotations.mean(axis=0))
        sine = np.sqrt(np.clip(1.0 - values**2, 0.0, 1.0))
        some = rotations[np.unique(np.linspace(0, len(rotations) - 1, _PAIRS).astype(int))]
        # trace(R_i' R_j) falls with the angle.
        flat = some.reshape(len(some), 9)
        first, second = np.unravel_index(np.argmin(flat @ flat.T), (len(some), len(some)))
        angle = np.linalg.norm(rotation_vector(some[first] @ some[second].T))
        return cls(axes, np.arcsin(sine), float(angle))

    def describe(self) -> str:
        """Return the angles by axis, for a message."""
        parts = [
            f"{np.degrees(swing):.1f} deg along ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})"
            for axis, swing in zip(self.axes, self.swing_rad, strict=True)
        ]
        return (
            f"the tool's directions swung by {', '.join(parts)} (RMS, in the tool's coordinates); "
            f"the orientations span {np.degrees(self.range_rad):.1f} deg"
        )


def validate_poses(
    rotations: Array, translations_mm: Array, covariances: Array | None
) -> tuple[Array, Array, Array | None]:
    """Return poses as float64 arrays.

    Args:
        rotations: R_world_tool, shape (N, 3, 3).
        translations_mm: shape (N, 3) [mm].
        covariances: covariance of rotation [rad] and translation [mm], as in ToolPose, shape
            (N, 6, 6); None: unknown, and equal for all.

    Raises:
        InvalidParameter: shapes do not match, a matrix is no rotation, or a covariance is not
            positive definite.
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
