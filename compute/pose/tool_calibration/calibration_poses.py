"""Poses for pivot and spin calibration: validation, and their orientation coverage."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from compute.errors import HighError, InvalidParameter, NonFiniteValue
from compute.transform import rotation_matrix, rotation_vector

Array = NDArray[np.float64]

_PAIRS = 400


@dataclass(frozen=True, eq=False)
class OrientationCoverage:
    """Coverage of a tool's orientations.

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
        """Return the coverage of N orientations R_world_tool (N, 3, 3)."""
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


@dataclass(frozen=True, eq=False)
class CalibrationPoses:
    """N poses of a tool.

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

    rotations: Array
    translations_mm: Array
    covariances: Array | None

    def __post_init__(self) -> None:
        count = len(self.translations_mm)
        for name, shape in _SHAPES.items():
            if getattr(self, name) is None:
                continue
            array = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, array)
            if array.shape != (count, *shape):
                raise InvalidParameter(
                    f"{name} has shape {array.shape}; it must be {(count, *shape)}"
                )
            bad = ~np.isfinite(array.reshape(count, -1)).all(axis=1)
            if bad.any():
                raise NonFiniteValue(
                    f"{name} of pose {int(np.argmax(bad))} is not finite; leave out poses that "
                    "are not known",
                    pose=int(np.argmax(bad)),
                )
        rotations = self.rotations
        off = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).reshape(count, -1)
        bad = (off > 1e-6).any(axis=1) | (np.linalg.det(rotations) < 0.0)
        if bad.any():
            pose = int(np.argmax(bad))
            raise InvalidParameter(f"the matrix of pose {pose} is no rotation", pose=pose)
        if self.covariances is not None:
            smallest = np.linalg.eigvalsh(self.covariances)[:, 0]
            if (smallest <= 0.0).any():
                pose = int(np.argmin(smallest))
                raise InvalidParameter(
                    f"the covariance of pose {pose} is not positive definite", pose=pose
                )

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.translations_mm)

    def of(self, used: NDArray[np.bool_] | NDArray[np.intp]) -> "CalibrationPoses":
        """Return some of the poses."""
        some = object.__new__(CalibrationPoses)
        for name in _SHAPES:
            array = getattr(self, name)
            object.__setattr__(some, name, None if array is None else array[used])
        return some

    def adjusted_rotations(self, jacobian: Array, weighted_residual: Array) -> Array:
        """Return the orientations, adjusted within their covariances, shape (N, 3, 3).

        The gradient of the likelihood is that at the adjusted orientations: with the measured ones,
        their noise would bias the result towards the tool's origin.

        Args:
            jacobian: Jacobian of the R residuals of a pose with respect to it, shape (N, R, 6).
            weighted_residual: information times residuals, shape (N, R).
        """
        if self.covariances is None:
            return self.rotations
        correction = np.einsum("nij,nkj,nk->ni", self.covariances, jacobian, weighted_residual)
        adjusted: Array = rotation_matrix(-correction[:, :3]) @ self.rotations
        return adjusted


_SHAPES: Final = {"rotations": (3, 3), "translations_mm": (3,), "covariances": (6, 6)}


def check_agreement(
    used: NDArray[np.bool_], min_poses: int, max_outlier_fraction: float, cause: str
) -> None:
    """Refuse poses of which too many do not fit the others.

    Args:
        used: which poses fit, shape (N,).
        min_poses: smallest number of poses that fit.
        max_outlier_fraction: largest fraction of poses that do not.
        cause: what may have caused it, for the message.

    Raises:
        HighError: fewer fit.
    """
    outlying = np.flatnonzero(~used)
    if len(used) - len(outlying) >= max(min_poses, (1.0 - max_outlier_fraction) * len(used)):
        return
    raise HighError(
        f"{len(outlying)} of {len(used)} poses do not fit the others (the first: "
        f"{outlying[:10].tolist()}); at least {min_poses} poses and "
        f"{1.0 - max_outlier_fraction:.0%} of them must agree: {cause}",
        outlying=len(outlying),
        poses=len(used),
    )
