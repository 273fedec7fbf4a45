"""PriorTracks: known positions and velocities of markers, checked."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]

_MOVING = 6
_SYMMETRIC = 1e-9
"""Difference of a covariance from its transpose, in parts of its largest entry."""


@dataclass(frozen=True, eq=False)
class PriorTracks:
    """Known positions and velocities of N markers, from other sources than the readings.

    Args:
        mean: place and velocity, shape (N, 6) [mm, mm/s].
        covariance: of these, shape (N, 6, 6).
    """

    mean: Array
    covariance: Array

    @classmethod
    def of(cls, position_mm: Array, velocity_mm_s: Array, covariance: Array) -> "PriorTracks":
        """Check positions and velocities of N markers.

        Args:
            position_mm: shape (N, 3) [mm].
            velocity_mm_s: shape (N, 3) [mm/s].
            covariance: of position and velocity, shape (N, 6, 6), or (6, 6) for all alike.

        Raises:
            InvalidParameter: other shapes, a value that is not finite, or a covariance that is not
                symmetric and positive definite.
        """
        place = np.asarray(position_mm, dtype=np.float64)
        velocity = np.asarray(velocity_mm_s, dtype=np.float64)
        spread = np.asarray(covariance, dtype=np.float64)
        if place.ndim != 2 or place.shape[1] != 3:
            raise InvalidParameter(f"position_mm has the shape {place.shape}; it must be (N, 3)")
        if velocity.shape != place.shape:
            raise InvalidParameter(
                f"velocity_mm_s has the shape {velocity.shape}; it must be {place.shape}"
            )
        each = (len(place), _MOVING, _MOVING)
        if spread.shape == each[1:]:
            spread = np.broadcast_to(spread, each)
        if spread.shape != each:
            raise InvalidParameter(
                f"covariance has the shape {spread.shape}; it must be {each} or {each[1:]}, of "
                "place and velocity"
            )
        mean = np.concatenate([place, velocity], axis=1)
        for marker, (state, matrix) in enumerate(zip(mean, spread, strict=True)):
            _check(marker, state, matrix)
        return cls(mean, spread.copy())

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.mean)


def _check(marker: int, mean: Array, covariance: Array) -> None:
    if not np.isfinite(mean).all():
        raise InvalidParameter(
            f"marker {marker} is at {mean[:3].tolist()} mm with {mean[3:].tolist()} mm/s; all must "
            "be finite"
        )
    if not np.isfinite(covariance).all():
        raise InvalidParameter(f"covariance of marker {marker} is not finite")
    off = np.abs(covariance - covariance.T).max()
    if off > _SYMMETRIC * np.abs(covariance).max():
        raise InvalidParameter(
            f"covariance of marker {marker} is off its transpose by {off:.3g}; it must be symmetric"
        )
    least = float(np.linalg.eigvalsh(covariance)[0])
    if not least > 0.0:
        raise InvalidParameter(
            f"covariance of marker {marker} has the eigenvalue {least:.3g}; all must be above 0"
        )
