"""Background: ambient light along a line, as mean electrons in each pixel of an exposure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]


class Background(Protocol):
    """The shape of ambient light along a line."""

    def electrons(self, pixels: int) -> Array:
        """Return mean electrons, shape (pixels,); parts of a sum may be negative."""
        ...


@dataclass(frozen=True)
class ConstantBackground:
    """The same in every pixel.

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
    """A polynomial along the line, as the thesis takes off in section 4.4.

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
    """A Gaussian bump: a window, a lamp, the reflection of one.

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
class TabulatedBackground:
    """A measured background, linear between its pixels and even beyond them.

    Args:
        positions_px: ascending [px].
        levels_electrons: mean electrons there.

    Raises:
        InvalidParameter: no or unequal numbers of values, values not finite, positions that do
            not ascend.
    """

    positions_px: tuple[float, ...]
    levels_electrons: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_finite(self, "positions_px", "levels_electrons")
        if not self.positions_px or not (np.diff(self.positions_px) > 0.0).all():
            raise InvalidParameter(
                f"positions_px is {self.positions_px}; it must have one or more, ascending",
                positions_px=self.positions_px,
            )
        if len(self.levels_electrons) != len(self.positions_px):
            raise InvalidParameter(
                f"levels_electrons has {len(self.levels_electrons)} values; it must have "
                f"{len(self.positions_px)}, one for each position",
                levels_electrons=self.levels_electrons,
            )

    def electrons(self, pixels: int) -> Array:
        """Return mean electrons, shape (pixels,)."""
        return np.asarray(np.interp(np.arange(pixels), self.positions_px, self.levels_electrons))


@dataclass(frozen=True)
class SumBackground:
    """Several backgrounds at once.

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
