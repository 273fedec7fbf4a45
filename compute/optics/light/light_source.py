"""Markers as sources of light: interface, directions to the lenses, photons of an energy."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.constants import c, h

from compute.errors import InvalidParameter
from compute.parameter_checks import require, require_shape

Array = NDArray[np.float64]


class LightSource(Protocol):
    """A marker as a source of light, active or retro-reflective."""

    @property
    def wavelength_nm(self) -> float:
        """Mean wavelength [nm]."""
        ...

    @property
    def spectral_width_nm(self) -> float:
        """Full width at half maximum of the spectrum [nm]."""
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
            points_mm: positions of N markers in the world, shape (N, 3) [mm].
            facing: directions in which they face, any length, shape (N, 3); None: each towards
                every lens.
            lens_positions_mm: centres of S lenses, shape (S, 3) [mm].
            exposure_s: length of the exposure [s].

        Returns:
            Shape (N, S) [1/sr], independent of the distance to the lens: the solid angle through
            which a pixel collects light falls with it.

        Raises:
            InvalidParameter: arrays of another shape, a direction without length, a negative
                exposure.
        """
        ...


def photons(energy_j: Array, wavelength_nm: float) -> Array:
    """Return the number of photons of a radiant energy, any shape: ``E wavelength / (h c)``.

    Args:
        energy_j: radiant energy, any shape [J].
        wavelength_nm: mean wavelength [nm].
    """
    return np.asarray(energy_j * (wavelength_nm * 1e-9 / (h * c)))


def directions(from_mm: Array, to_mm: Array) -> tuple[Array, Array]:
    """Return unit vectors and distances, shapes (..., 3) and (...) [mm]; zero for no distance.

    Args:
        from_mm: start points, shape (..., 3) [mm].
        to_mm: end points, of a shape that broadcasts [mm].
    """
    path = to_mm - from_mm
    distance = np.linalg.norm(path, axis=-1)
    return path / np.where(distance > 0.0, distance, 1.0)[..., None], distance


def towards_lenses(points_mm: Array, lens_positions_mm: Array) -> Array:
    """Return unit vectors from points to lenses, shape (N, S, 3).

    Args:
        points_mm: shape (N, 3) [mm].
        lens_positions_mm: shape (S, 3) [mm].

    Raises:
        InvalidParameter: an array of another shape.
    """
    for name, value in (("points_mm", points_mm), ("lens_positions_mm", lens_positions_mm)):
        require_shape(value.ndim == 2 and value.shape[1] == 3, "be (number, 3)", **{name: value})
    return directions(points_mm[:, None, :], lens_positions_mm)[0]


def unit_facing(facing: Array, points_mm: Array) -> Array:
    """Return the directions in which markers face as unit vectors, shape (N, 3).

    Args:
        facing: directions of any length, shape (N, 3).
        points_mm: the markers, shape (N, 3) [mm].

    Raises:
        InvalidParameter: of another shape than the points, or a direction without length.
    """
    right = f"be that of points_mm, {points_mm.shape}"
    require_shape(facing.shape == points_mm.shape, right, facing=facing)
    length = np.linalg.norm(facing, axis=1)
    wrong = ~((length > 0.0) & (length < np.inf))
    if wrong.any():
        value = tuple(facing[wrong][0].tolist())
        raise InvalidParameter(f"facing has {value}; it must have a length", facing=value)
    return np.asarray(facing / length[:, None])


def check_exposure(exposure_s: float) -> None:
    """Raise InvalidParameter for an exposure that is negative or not finite [s]."""
    require(0.0 <= exposure_s < np.inf, "be zero or positive", exposure_s=exposure_s)
