"""Ideal cylindrical lenses: perspective projection, constant width, light by distance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.optics.sensor_placement import PlacedSensor
from compute.parameter_checks import require

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GaussianStripes:
    """Stripes of N points on S sensors, each of a Gaussian shape along the pixels.

    Args:
        position_px: centre of the line, shape (N, S) [px]; NaN where the sensor sees nothing.
        sigma_px: standard deviation of the line's shape, shape (N, S) [px].
        electrons: mean number of electrons of the whole line, shape (N, S).
    """

    position_px: Array
    sigma_px: Array
    electrons: Array


class IdealOptics:
    """Lenses without aberration in front of S placed sensors.

    The light that a lens collects falls with the square of the distance r to its centre:
    ``electrons = signal_electrons (reference_distance_mm / r)^2``.

    Args:
        sensors: the placed sensors, in the device's order.
        spot_sigma_px: standard deviation of every line's shape [px].
        signal_electrons: mean electrons of a line at the reference distance.
        reference_distance_mm: that distance [mm]; None: as bright at every distance.

    Raises:
        InvalidParameter: a width, signal or distance is not positive (a signal may be zero).
    """

    def __init__(
        self,
        sensors: Sequence[PlacedSensor],
        *,
        spot_sigma_px: float,
        signal_electrons: float,
        reference_distance_mm: float | None,
    ) -> None:
        require(0.0 < spot_sigma_px < np.inf, "be positive", spot_sigma_px=spot_sigma_px)
        valid = 0.0 <= signal_electrons < np.inf
        require(valid, "be zero or positive", signal_electrons=signal_electrons)
        valid = reference_distance_mm is None or 0.0 < reference_distance_mm < np.inf
        require(valid, "be positive, or None", reference_distance_mm=reference_distance_mm)
        self._cameras = CameraStack.of([sensor.model for sensor in sensors])
        self._lenses_mm = np.array([sensor.lens_position_mm for sensor in sensors]).reshape(-1, 3)
        self._sigma_px = spot_sigma_px
        self._signal_electrons = signal_electrons
        self._reference_mm = reference_distance_mm

    def stripes(self, points_mm: NDArray[np.float64]) -> GaussianStripes:
        """Return the stripes of points (N, 3) in the world frame [mm].

        A point in the lens's plane or behind it has the position NaN and no light.
        """
        position = self._cameras.project(points_mm)
        electrons = np.full_like(position, self._signal_electrons)
        if self._reference_mm is not None:
            towards = points_mm[:, None, :] - self._lenses_mm
            # In front of a lens r > 0, but the square may underflow: floored at a micrometre.
            squared = np.maximum((towards**2).sum(axis=2), 1e-6)
            electrons *= self._reference_mm**2 / squared
        electrons[np.isnan(position)] = 0.0
        return GaussianStripes(position, np.full_like(position, self._sigma_px), electrons)
