"""The dynamic model of section 6.1.1: constant velocity in two dimensions and along a sensor."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def transition_along_sensor(interval_s: float) -> Array:
    """Return F of [6.2], of position and velocity along one sensor, shape (2, 2).

    Args:
        interval_s: the sampling period, Delta T [s].
    """
    return np.array([[1.0, interval_s], [0.0, 1.0]])


def transition_in_plane(interval_s: float) -> Array:
    """Return F of [6.1], of x, y and their velocities, shape (4, 4).

    Args:
        interval_s: the sampling period, Delta T [s].
    """
    return np.asarray(np.kron(transition_along_sensor(interval_s), np.eye(2)), dtype=np.float64)
