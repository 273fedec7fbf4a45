"""Extrapolation of missing points of a subset, section 6.1.3."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from validation.thesis_tracking.quadratic_window import QuadraticWindow

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FilledPositions:
    """Positions without gaps.

    Args:
        position_px: shape (N,); NaN before the first point, which nothing precedes.
        created: where a point was made up, bool, shape (N,).
    """

    position_px: Array
    created: NDArray[np.bool_]


def fill_gaps(position_px: Array, window: QuadraticWindow | None = None) -> FilledPositions:
    """Insert points where none was seen, each from the target's motion before it.

    "The missing points in the subset could be recreated later by using a target's motion
    behaviour from the previous points and inserting a point based on calculation of this data."
    How it is calculated the text does not say: here by the window's curve, the one that it
    tracks with. Points made up count as points for those after them: so a long gap runs away
    from a curve that bends, which the text admits ("not very accurate especially for the
    nonlinear sections and for the sections with successive missing points").

    Args:
        position_px: of successive scans, shape (N,) [px]; NaN: missing.
        window: of the curve; None: the thesis's seven points.

    Raises:
        InvalidParameter: positions of another shape.
    """
    values = np.array(position_px, dtype=np.float64)
    if values.ndim != 1:
        raise InvalidParameter(
            f"positions have the shape {values.shape}; they must be those of one subset, (N,)",
            shape=values.shape,
        )
    window = QuadraticWindow() if window is None else window
    missing = np.isnan(values)
    seen = np.flatnonzero(~missing)
    first = int(seen[0]) if len(seen) else len(values)
    created = missing & (np.arange(len(values)) > first)
    for scan in np.flatnonzero(created).tolist():
        values[scan] = window.next_position(values[first:scan])
    return FilledPositions(values, created)
