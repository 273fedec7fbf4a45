"""Angular emission of a light source."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]


class AngularEmission(Protocol):
    """Pattern of a rotationally symmetric source; 1 on the axis, 0 behind it."""

    def relative(self, cosine: Array) -> Array:
        """Return the relative intensity at cosines of the angle to the axis, any shape."""
        ...

    @property
    def solid_angle_sr(self) -> float:
        """Radiant power by intensity on the axis [sr]: the integral of the pattern."""
        ...


@dataclass(frozen=True)
class CosinePower:
    """Generalised Lambertian pattern ``cos^m``, given by its half-intensity angle.

    ``m = -ln 2 / ln cos(half angle)``; 60 degrees give Lambert's m = 1.

    Args:
        half_angle_rad: angle at which the intensity is half of that on the axis, above 0 and
            below pi/2 [rad].

    Raises:
        InvalidParameter: an angle outside of this.
    """

    half_angle_rad: float

    def __post_init__(self) -> None:
        if not 1e-4 <= self.half_angle_rad < np.pi / 2 - 1e-4:
            raise InvalidParameter(
                f"half_angle_rad is {self.half_angle_rad}; it must be from 1e-4 to below pi/2",
                half_angle_rad=self.half_angle_rad,
            )

    @property
    def exponent(self) -> float:
        """The power m of the cosine."""
        return float(-np.log(2.0) / np.log(np.cos(self.half_angle_rad)))

    def relative(self, cosine: Array) -> Array:
        """Return the relative intensity, same shape."""
        return np.asarray(cosine.clip(0.0, 1.0) ** self.exponent)

    @property
    def solid_angle_sr(self) -> float:
        """``2 pi / (m + 1)`` [sr]."""
        return float(2.0 * np.pi / (self.exponent + 1.0))


@dataclass(frozen=True)
class TabulatedEmission:
    """Measured pattern, linear between its angles.

    Args:
        angles_rad: ascending, the first 0, the last at most pi/2 [rad]; dark beyond the last.
        intensities: at these angles; only their ratios to the first count.

    Raises:
        InvalidParameter: angles out of order or range, negative or too few intensities.
    """

    angles_rad: tuple[float, ...]
    intensities: tuple[float, ...]

    def __post_init__(self) -> None:
        angles, values = np.array(self.angles_rad), np.array(self.intensities)
        ordered = len(angles) >= 2 and angles[0] == 0.0 and bool((np.diff(angles) > 0.0).all())
        if not ordered or not angles[-1] <= np.pi / 2:
            raise InvalidParameter(
                f"angles_rad is {self.angles_rad}; it must ascend from 0 to at most pi/2, and "
                "have two or more angles",
                angles_rad=self.angles_rad,
            )
        valid = len(values) == len(angles) and bool((values >= 0.0).all())
        if not valid or not values[0] > 0.0 or not np.isfinite(values).all():
            raise InvalidParameter(
                f"intensities is {self.intensities}; it must have a finite value that is zero or "
                "positive for each angle, and a positive first",
                intensities=self.intensities,
            )

    def relative(self, cosine: Array) -> Array:
        """Return the relative intensity, same shape."""
        values = np.array(self.intensities) / self.intensities[0]
        angle = np.arccos(cosine.clip(-1.0, 1.0))
        return np.asarray(np.interp(angle, self.angles_rad, values, right=0.0))

    @property
    def solid_angle_sr(self) -> float:
        """``2 pi`` times the integral of pattern times sine [sr], exact for linear pieces."""
        a, values = np.array(self.angles_rad), np.array(self.intensities) / self.intensities[0]
        slope = np.diff(values) / np.diff(a)
        # The antiderivative of (v + s (x - a)) sin x is -(v + s (x - a)) cos x + s sin x.
        pieces = values[:-1] * np.cos(a[:-1]) - values[1:] * np.cos(a[1:])
        pieces += slope * np.diff(np.sin(a))
        return float(2.0 * np.pi * pieces.sum())
