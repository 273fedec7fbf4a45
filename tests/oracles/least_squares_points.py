"""Points from readings by weighted least squares, one by one, with SciPy and no derivatives."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import least_squares


def triangulate(
    project: Callable[[Any], Any], readings_px: Any, sigma_px: Any, start_mm: Any
) -> Any:
    """Return the points whose projections miss the readings least, shape (N, 3) [mm].

    Args:
        project: from points (N, 3) [mm] to readings (N, S) [px].
        readings_px: shape (N, S) [px]; NaN where not seen.
        sigma_px: their standard deviations, shape (N, S) [px].
        start_mm: where each search starts, shape (N, 3) [mm].
    """
    found = []
    for readings, sigma, start in zip(readings_px, sigma_px, start_mm, strict=True):
        seen = np.isfinite(readings)

        def misses(
            place: Any, readings: Any = readings, sigma: Any = sigma, seen: Any = seen
        ) -> Any:
            return ((project(place[None])[0] - readings) / sigma)[seen]

        found.append(least_squares(misses, start, x_scale=100.0, xtol=1e-12, ftol=1e-12).x)
    return np.array(found)
