"""Traced rays: end points, transmitted light, and why a ray was lost."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from compute.optics.tracing.shapes import Array


class RayStatus(IntEnum):
    """Status of a traced ray."""

    ARRIVED = 0
    """It reached the plane of the sensor."""
    MISSED = 1
    """It does not meet a surface."""
    STOPPED = 2
    """It met a surface outside of its opening."""
    TOTALLY_REFLECTED = 3
    """It could not leave a denser glass."""


@dataclass(frozen=True, eq=False)
class TracedRays:
    """N rays at the plane of the sensor, in the sensor's own frame (x along the pixels).

    A ray that did not arrive has NaN everywhere, a transmittance of zero, and tells where it
    was lost.

    Args:
        position_mm: shape (N, 3) [mm]; z is zero.
        direction: unit vectors, shape (N, 3).
        path_mm: optical path from the ray's origin, shape (N,) [mm].
        transmittance: share of the power that arrives, shape (N, 2): for light polarised at the
            start in the plane of the ray and the x axis, and across it; their mean is that of
            unpolarised light.
        status: RayStatus, int32, shape (N,).
        lost_at: number of the surface where it was lost, the image counting as the last; -1 for
            a ray that arrived; int32, shape (N,).
    """

    position_mm: Array
    direction: Array
    path_mm: Array
    transmittance: Array
    status: NDArray[np.int32]
    lost_at: NDArray[np.int32]
