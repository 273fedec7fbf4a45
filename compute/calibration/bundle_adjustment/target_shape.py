"""Shapes of calibration targets: a point, markers on a line, a rigid body."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.gauge import orthogonal_complement
from compute.errors import InvalidParameter

Array = NDArray[np.float64]

COLLINEARITY_LIMIT = 1e-6
"""Markers whose distance from a line is less than this, relative to its length, are on it."""


@dataclass(frozen=True)
class KnownDistance:
    """A measured distance between two markers of a shape.

    Args:
        first: index of a marker.
        second: index of another.
        length_mm: their distance [mm].
        sigma_mm: its standard deviation, positive [mm].
    """

    first: int
    second: int
    length_mm: float
    sigma_mm: float

    def __post_init__(self) -> None:
        if not (0.0 < self.length_mm < np.inf and 0.0 < self.sigma_mm < np.inf):
            raise InvalidParameter(
                f"a distance of {self.length_mm} +- {self.sigma_mm} mm between markers "
                f"{self.first + 1} and {self.second + 1}; both must be positive"
            )


@dataclass(frozen=True, eq=False)
class TargetShape:
    """K markers in the body frame, and the directions in which their shape is adjusted.

    Args:
        marker_mm: shape (K, 3) [mm]; of markers on a line along x.
        rotation_axes: which rotations about the body's axes the readings depend on.
        basis: directions of change, shape (M, K, 3), orthonormal and free of rigid motions;
            M = 0: exactly known.
        sigma_mm: standard deviation along each of them as a prior [mm]; inf: unknown.
        prior_mm: the shape that the prior is about, shape (K, 3).
        distances: measured distances between markers.
    """

    marker_mm: Array
    rotation_axes: tuple[int, ...]
    basis: Array
    sigma_mm: float
    prior_mm: Array
    distances: tuple[KnownDistance, ...] = ()

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.marker_mm)

    @property
    def unknowns(self) -> int:
        """Number of unknowns, M."""
        return len(self.basis)

    def retract(self, step: Array) -> "TargetShape":
        """Return the shape after a step along its basis, shape (M,)."""
        return replace(self, marker_mm=self.marker_mm + np.tensordot(step, self.basis, 1))

    def equations(self) -> tuple[Array, Array]:
        """Return residuals (R,) of prior and distances over sigma, and their Jacobian (R, M)."""
        rows: list[float] = []
        jacobian: list[Array] = []
        if self.unknowns and np.isfinite(self.sigma_mm):
            offset = np.tensordot(self.basis, self.marker_mm - self.prior_mm, 2)
            rows.extend((offset / self.sigma_mm).tolist())
            jacobian.extend(np.eye(self.unknowns) / self.sigma_mm)
        for known in self.distances:
            between = self.marker_mm[known.first] - self.marker_mm[known.second]
            length = float(np.linalg.norm(between))
            rows.append((length - known.length_mm) / known.sigma_mm)
            change = self.basis[:, known.first] - self.basis[:, known.second]
            jacobian.append(change @ between / (length * known.sigma_mm))
        return np.array(rows), np.array(jacobian).reshape(len(rows), self.unknowns)


def point_shape() -> TargetShape:
    """Return the shape of a single marker."""
    return TargetShape(np.zeros((1, 3)), (), np.zeros((0, 1, 3)), np.inf, np.zeros((1, 3)))


def line_shape(position_mm: Sequence[float] | Array, sigma_mm: float = 0.0) -> TargetShape:
    """Return the shape of markers on a line.

    Args:
        position_mm: their positions along it, shape (K,), at least two, all different [mm].
        sigma_mm: standard deviation of each position [mm]; 0: exact.

    Raises:
        InvalidParameter: fewer than two markers, two that coincide, or a value not finite.
    """
    along = np.asarray(position_mm, dtype=np.float64)
    if along.ndim != 1 or len(along) < 2 or not np.isfinite(along).all():
        raise InvalidParameter(
            f"markers on a line at {along.tolist()} mm; give two or more finite positions"
        )
    if len(np.unique(along)) < len(along):
        raise InvalidParameter(f"markers on a line at {along.tolist()} mm; no two may coincide")
    marker = np.zeros((len(along), 3))
    marker[:, 0] = along - along.mean()
    changes = np.zeros((0, len(along), 3))
    if _varies(sigma_mm):
        changes = np.zeros((len(along) - 1, len(along), 3))
        # All directions but a common shift along the line.
        changes[..., 0] = orthogonal_complement(np.ones((len(along), 1))).T
    return TargetShape(marker, (1, 2), changes, sigma_mm, marker)


def body_shape(
    marker_mm: Array, sigma_mm: float = 0.0, distances: Sequence[KnownDistance] = ()
) -> TargetShape:
    """Return the shape of a rigid body of three or more markers, about their centroid.

    Args:
        marker_mm: shape (K, 3), K >= 3, not on one line [mm].
        sigma_mm: standard deviation of each coordinate [mm]; 0: exact; inf: unknown shape, of
            which ``marker_mm`` is a start and only the distances count.
        distances: measured distances between markers.

    Raises:
        InvalidParameter: fewer than three markers, all on a line, or a value that is not finite.
    """
    positions = np.asarray(marker_mm, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1:] != (3,) or len(positions) < 3:
        raise InvalidParameter(
            f"markers of a rigid body have shape {positions.shape}; it must be (K, 3), K >= 3"
        )
    if not np.isfinite(positions).all():
        raise InvalidParameter("markers of a rigid body must be finite")
    marker = positions - positions.mean(axis=0)
    extent = np.linalg.svd(marker, compute_uv=False)
    if extent[1] <= COLLINEARITY_LIMIT * extent[0]:
        raise InvalidParameter(
            f"the {len(marker)} markers of the rigid body lie on a line (RMS extents "
            f"{extent[0]:.3g} and {extent[1]:.3g} mm); describe it as markers on a line"
        )
    changes = np.zeros((0, len(marker), 3))
    if _varies(sigma_mm):
        axes = np.eye(3)
        shifts = np.broadcast_to(axes[:, None], (3, len(marker), 3))
        rotated = np.cross(axes[:, None], marker)
        rigid = np.concatenate([shifts, rotated]).reshape(6, -1).T
        changes = orthogonal_complement(rigid).T.reshape(-1, len(marker), 3)
    return TargetShape(marker, (0, 1, 2), changes, sigma_mm, marker, tuple(distances))


def _varies(sigma_mm: float) -> bool:
    if not sigma_mm >= 0.0:
        raise InvalidParameter(f"sigma_mm of a shape is {sigma_mm}; it must be 0 or more")
    return sigma_mm > 0.0
