"""Interface of the markers as sources of light."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class LightSource(Protocol):
    """A marker as a source of light, active or retro-reflective."""

    @property
    def wavelength_nm(self) -> float:
        """Mean wavelength of its light [nm]."""
        ...

    @property
    def spectral_width_nm(self) -> float:
        """Full width at half maximum of its spectrum [nm]."""
        ...

    @property
    def width_mm(self) -> float:
        """Width of the emitting part, seen from the front [mm]; it blurs the stripe."""
        ...

    def photons_per_sr(
        self, points_mm: Array, facing: Array | None, lens_positions_mm: Array, exposure_s: float
    ) -> Array:
        """Return the photons that markers send towards lenses in an exposure, per steradian.

        Args:
            points_mm: where the markers are, shape (N, 3) [mm].
            facing: directions in which they face, any length, shape (N, 3); None: each towards
                every lens.
            lens_positions_mm: shape (S, 3) [mm].
            exposure_s: length of the exposure [s].

        Returns:
            Shape (N, S) [1/sr]. The way to the lens is not in it: the solid angle through which
            a pixel collects light falls with the distance.

        Raises:
            InvalidParameter: arrays of another shape, a direction without length, a negative
                exposure.
        """
        ...
