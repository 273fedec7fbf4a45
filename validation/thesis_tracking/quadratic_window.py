"""Quadratic window: a parabola through the last points of a track, section 6.1.3."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]

THESIS_POINTS: Final = 7
"""Section 6.1.3: "a quadratic curve fit over a certain number of points (n = 7)"."""

_DEGREE: Final = 2


@dataclass(frozen=True)
class WindowFit:
    """The curve at the last point of the window, and one scan on.

    Args:
        position: at the last point.
        velocity: there, per scan.
        acceleration: of the whole curve, per scan squared.
        next_position: one scan on, the predicted position.
    """

    position: float
    velocity: float
    acceleration: float
    next_position: float


@dataclass(frozen=True)
class QuadraticWindow:
    """Least squares of a parabola to the last ``points`` positions, one a scan.

    Where a track has fewer, so many are taken: through two the curve is a line, and one stays
    where it is.

    Args:
        points: n of section 6.1.3, 3 or more; at 3 the curve goes through all.

    Raises:
        InvalidParameter: fewer than 3.
    """

    points: int = THESIS_POINTS

    def __post_init__(self) -> None:
        if self.points < _DEGREE + 1:
            raise InvalidParameter(
                f"points is {self.points}; a quadratic curve needs {_DEGREE + 1} at least",
                points=self.points,
            )

    def fit(self, positions: ArrayLike) -> WindowFit:
        """Fit the last points of a track.

        Args:
            positions: of successive scans, the last one last, shape (N,), N >= 1, no NaN.

        Raises:
            InvalidParameter: no positions.
        """
        values = np.asarray(positions, dtype=np.float64)[-self.points :]
        if not len(values):
            raise InvalidParameter("there are no positions; the window needs one at least")
        # Relative to the last: of large positions digits would be lost.
        coefficients = _solution(len(values)) @ (values - values[-1])
        constant, slope, curve = (*coefficients.tolist(), 0.0, 0.0)[: _DEGREE + 1]
        last = float(values[-1])
        return WindowFit(last + constant, slope, 2.0 * curve, last + constant + slope + curve)

    def next_position(self, positions: ArrayLike) -> float:
        """Return the predicted position one scan after the last, as ``fit`` does."""
        return self.fit(positions).next_position

    def next_deviation(self, deviations: ArrayLike) -> float:
        """Return what deviations of the points make of the predicted position, at most.

        The sum of each point's share: exact where all errors are one, as when some of the points
        are made up from the others. How far the target leaves the curve is not in it.

        Args:
            deviations: standard deviations of the last points, as ``fit`` has them.
        """
        values = np.asarray(deviations, dtype=np.float64)[-self.points :]
        return float(np.abs(_ahead(len(values))) @ values)


@lru_cache(maxsize=64)
def _solution(points: int) -> Array:
    """Return the matrix from values to coefficients about the last point, lowest power first."""
    scan = np.arange(points, dtype=np.float64) - (points - 1)
    return np.asarray(np.linalg.pinv(np.vander(scan, min(points, _DEGREE + 1), increasing=True)))


@lru_cache(maxsize=64)
def _ahead(points: int) -> Array:
    """Return the share of each point in the predicted position, shape (points,)."""
    share = _solution(points).sum(axis=0)
    # The fit is relative to the last point.
    share[-1] += 1.0 - share.sum()
    return np.asarray(share)
