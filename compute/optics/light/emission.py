"""Angular emission of a light source: relative intensity, 1 on the axis."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.parameter_checks import require

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CosinePower:
    """Generalised Lambertian pattern ``cos^m``, given by its half-intensity angle.

    ``m = -ln 2 / ln cos(half angle)``; 60 degrees give Lambert's m = 1.

    Args:
        half_angle_rad: angle at which the intensity is half of that on the axis, above 0 and
            below pi/2 [rad].

    Raises:
        InvalidParameter: an angle out of range.
    """

    half_angle_rad: float

    def __post_init__(self) -> None:
        require(
            1e-4 <= self.half_angle_rad < np.pi / 2 - 1e-4,
            "be from 1e-4 to below pi/2",
            half_angle_rad=self.half_angle_rad,
        )

    @property
    def exponent(self) -> float:
        """The power m of the cosine."""
        return float(-np.log(2.0) / np.log(np.cos(self.half_angle_rad)))

    def relative(self, cosine: Array) -> Array:
        """Return the relative intensity at cosines of the angle to the axis, any shape."""
        return np.asarray(cosine.clip(0.0, 1.0) ** self.exponent)


@dataclass(frozen=True)
class EvenEmission:
    """The same intensity in all directions of the half space in front."""

    def relative(self, cosine: Array) -> Array:
        """Return the relative intensity at cosines of the angle to the axis, any shape."""
        return np.where(cosine >= 0.0, 1.0, 0.0)


AngularEmission = CosinePower | EvenEmission
