"""Retro-reflective spheres, as two targets of Test 4.1."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compute.optics.light.light_source import towards_lenses, unit_facing
from compute.optics.light.retroreflector import RetroDisc

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RetroSphere(RetroDisc):
    """A sphere covered with retro-reflective sheet; it faces everywhere.

    Args:
        diameter_mm: of the sphere [mm].
        sheet: its material.
        illuminator: what lights it.

    Raises:
        InvalidParameter: a diameter that is not positive.
    """

    def photons_per_sr(
        self, points_mm: Array, facing: Array | None, lens_positions_mm: Array, exposure_s: float
    ) -> Array:
        """Return the photons towards each lens, shape (N, S) [1/sr].

        They fall with the square of the distance to the illuminator.

        Args:
            points_mm, facing, lens_positions_mm, exposure_s: as of ``LightSource``.
        """
        if facing is not None:
            unit_facing(facing, points_mm)
        towards = towards_lenses(points_mm, lens_positions_mm)
        return self.reflected_photons(points_mm, towards, exposure_s) * self.effective_area_m2

    @cached_property
    def effective_area_m2(self) -> float:
        """Area of the disc facing the light that returns the same light [m^2].

        The sum of ``cos(b) 2^-(b/b_half)^2`` over the lit half of the sphere, at most its
        projected area: ``2 pi R^2`` times the integral of it times sin(b).
        """
        node, weight = np.polynomial.legendre.leggauss(64)
        entrance = np.pi / 4.0 * (node + 1.0)
        integral = (
            np.pi / 4.0 * (weight * np.sin(entrance) * self.sheet.entrance_factor(entrance)).sum()
        )
        return float(2.0 * self.face_m2 * integral)
