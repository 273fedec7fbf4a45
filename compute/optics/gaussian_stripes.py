"""GaussianStripes: where the light of each marker meets each sensor's line, how wide and how bright."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GaussianStripes:
    """The light lines of N points on S sensors, each of a Gaussian shape along the pixels.

    Args:
        position_px: centre of the line, shape (N, S) [px]; NaN where the sensor sees nothing.
        sigma_px: standard deviation of the line's shape, shape (N, S) [px].
        electrons: mean number of electrons of the whole line, shape (N, S).
    """

    position_px: Array
    sigma_px: Array
    electrons: Array


class StripeOptics(Protocol):
    """What forms the light lines; ideal lenses today, traced ones behind the same door."""

    def stripes(self, points_mm: Array) -> GaussianStripes:
        """Return the spots of points (N, 3) in the world frame [mm]."""
        ...
