"""Ambient light along a row of pixels, as mean electrons of an exposure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]


class Background(Protocol):
    """Ambient light along a row of pixels."""

    def electrons(self, pixels: int) -> Array:
        """Return mean electrons, shape (pixels,); parts of a sum may be negative."""
        ...


@dataclass(frozen=True)
class ConstantBackground:
    """The same level in every pixel.

    Args:
        level_electrons: mean electrons.

    Raises:
        InvalidParameter: a level that is not finite.
    """

    level_electrons: float

    def __post_init__(self) -> None:
        _check_finite(self, "level_electrons")

    def electrons(self, pixels: int) -> Array:
        """Return mean electrons, shape (pixels,)."""
        return np.full(pixels, self.level_electrons)


@dataclass(frozen=True)
class PolynomialBackground:
    """A polynomial along the row, which the thesis subtracts in section 4.4.

    Args:
        coefficients_electrons: of the powers 0, 1, 2, ... of x, which is -1 at the first pixel
            and 1 at the last.

    Raises:
        InvalidParameter: no coefficient, or one that is not finite.
    """

    coefficients_electrons: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_finite(self, "coefficients_electrons")
        if not self.coefficients_electrons:
            raise InvalidParameter(
                "coefficients_electrons is empty; it must have one or more",
                coefficients_electrons=(),
            )

    def electrons(self, pixels: int) -> Array:
        """Return mean electrons, shape (pixels,)."""
        x = np.linspace(-1.0, 1.0, pixels)
        return np.asarray(np.polynomial.polynomial.polyval(x, self.coefficients_electrons))


@dataclass(frozen=True)
class BumpBackground:
    """A Gaussian bump: a window, a lamp, a reflection.

    Args:
        centre_px: its place, on the line or beside it [px].
        sigma_px: its standard deviation, positive [px].
        peak_electrons: its height.

    Raises:
        InvalidParameter: a value that is not finite, a width that is not positive.
    """

    centre_px: float
    sigma_px: float
    peak_electrons: float

    def __post_init__(self) -> None:
        _check_finite(self, "centre_px", "sigma_px", "peak_electrons")
        if not self.sigma_px > 0.0:
            raise InvalidParameter(
                f"sigma_px is {self.sigma_px}; it must be positive", sigma_px=self.sigma_px
            )

    def electrons(self, pixels: int) -> Array:
        """Return mean electrons, shape (pixels,)."""
        deviation = (np.arange(pixels) - self.centre_px) / self.sigma_px
        return np.asarray(self.peak_electrons * np.exp(-0.5 * deviation**2))


@dataclass(frozen=True)
class SumBackground:
    """Sum of several backgrounds.

    Args:
        parts: the backgrounds; none: no light.
    """

    parts: tuple[Background, ...]

    def electrons(self, pixels: int) -> Array:
        """Return mean electrons, shape (pixels,)."""
        total = np.zeros(pixels)
        for part in self.parts:
            total += part.electrons(pixels)
        return total


def background_scans(backgrounds: Sequence[Background], pixels: int) -> Array:
    """Return the backgrounds of S sensors as ``DetectorArray`` takes them, shape (S, pixels).

    Args:
        backgrounds: of the S sensors.
        pixels: pixels of a row.

    Raises:
        InvalidParameter: a background that is negative somewhere on its line.
    """
    lines = np.array([background.electrons(pixels) for background in backgrounds])
    lines = lines.reshape(len(backgrounds), pixels)
    if (lines < 0.0).any():
        sensor, pixel = divmod(int(lines.argmin()), pixels)
        raise InvalidParameter(
            f"background {backgrounds[sensor]} has {lines[sensor, pixel]:g} electrons in pixel "
            f"{pixel} of sensor {sensor}; it must be zero or positive on the whole line",
            backgrounds=backgrounds[sensor],
        )
    return lines


def _check_finite(holder: object, *names: str) -> None:
    for name in names:
        value = getattr(holder, name)
        if not np.isfinite(value).all():
            raise InvalidParameter(f"{name} is {value}; it must be finite", **{name: value})
