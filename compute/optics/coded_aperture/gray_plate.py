"""GrayPlate: tracks of transparent and opaque zones in Gray code, a detector behind each."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.gray_code import gray_encode, to_bits
from compute.optics.pixel_solid_angles import PixelSolidAngles

Array = NDArray[np.float64]

_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class GrayPlate:
    """The plate of Mitchelson's instrument: a line of light lies across tracks of zones.

    The thesis (section 2.3, Figure 2.3) gives Gray code, "additional analogue-to-digital
    conversion", 12 bits in all and 10 mm of receptive length, and not how the bits are divided.
    Assumed here, as a builder of 1971 would: ``gray_bits`` Gray tracks divide the plate into
    ``2**gray_bits`` cells, and four tracks in quadrature (sine, its complement, cosine, its
    complement), with a period of four cells, are interpolated to ``analogue_bits`` more. The
    finest Gray track is the complement of the cosine, so three tracks are added. The sum of
    a track and its complement is the reference for all thresholds.

    The plate's coordinate runs from 0 to ``length_mm`` along growing readings. Tracks are in
    the order: Gray code, coarsest first; sine; complement of the sine; cosine.

    Args:
        gray_bits: tracks of the Gray code, 2 to 12.
        analogue_bits: bits of the interpolation in a cell, 0 to 12.
        length_mm: length of the code on the plate [mm].

    Raises:
        InvalidParameter: a value out of its range.
    """

    gray_bits: int = 8
    analogue_bits: int = 4
    length_mm: float = 10.0

    def __post_init__(self) -> None:
        for name, low in (("gray_bits", 2), ("analogue_bits", 0)):
            value = getattr(self, name)
            if not low <= value <= 12:
                raise InvalidParameter(
                    f"{name} is {value}; it must be {low} to 12", **{name: value}
                )
        if not 0.0 < self.length_mm < np.inf:
            raise InvalidParameter(
                f"length_mm is {self.length_mm}; it must be positive", length_mm=self.length_mm
            )

    @property
    def tracks(self) -> int:
        """Number of tracks, one detector behind each."""
        return self.gray_bits + 3

    @property
    def bits(self) -> int:
        """Resolution in bits, digital and analogue together."""
        return self.gray_bits + self.analogue_bits

    @property
    def cell_mm(self) -> float:
        """Length of a cell, the step of the Gray code [mm]."""
        return float(self.length_mm / 2**self.gray_bits)

    @property
    def step_mm(self) -> float:
        """Step of the whole resolution [mm]."""
        return float(self.length_mm / 2**self.bits)

    @property
    def quantisation_sigma_mm(self) -> float:
        """Standard deviation of the rounding to whole steps, step / sqrt(12) [mm]."""
        return float(self.step_mm / np.sqrt(12.0))

    @cached_property
    def transparent(self) -> NDArray[np.bool_]:
        """Which cells of which track are transparent, shape (cells, tracks)."""
        cell = np.arange(2**self.gray_bits)
        gray = to_bits(gray_encode(cell), self.gray_bits)
        quarter = cell % 4
        sine, cosine = quarter < 2, (quarter == 0) | (quarter == 3)
        return np.column_stack([gray, sine, ~sine, cosine])

    def outputs(self, position_mm: Array, sigma_mm: Array) -> Array:
        """Return the share of a line's light that passes each track, shape (..., tracks).

        Args:
            position_mm: centre of the line on the plate, shape (...) [mm]; NaN: no line.
            sigma_mm: standard deviation of its Gaussian shape, same shape [mm]; may be zero.

        Raises:
            InvalidParameter: a width that is negative or not finite.
        """
        position, sigma = np.broadcast_arrays(position_mm, sigma_mm)
        if not ((sigma >= 0.0) & np.isfinite(sigma)).all():
            raise InvalidParameter(
                f"sigma_mm has {sigma[~((sigma >= 0.0) & np.isfinite(sigma))][0]}; it must be "
                "zero or positive",
                sigma_mm=sigma_mm,
            )
        edges = np.arange(2**self.gray_bits + 1) * self.cell_mm
        zones = self.transparent.astype(np.float64)
        lines = np.nan_to_num(position.reshape(-1, 1), nan=-np.inf, posinf=-np.inf)
        # A line without width is one far narrower than any cell.
        widths = np.maximum(sigma.reshape(-1, 1), 1e-9 * self.cell_mm)
        passed = np.empty((len(lines), self.tracks))
        chunk = max(1, _AT_ONCE // len(edges))
        for start in range(0, len(lines), chunk):
            part = slice(start, start + chunk)
            passed[part] = np.diff(ndtr((edges - lines[part]) / widths[part]), axis=1) @ zones
        return passed.reshape(*position.shape, self.tracks)

    def solid_angles(
        self, position_mm: Array, sigma_mm: Array, track_sr: Array
    ) -> PixelSolidAngles:
        """Return footprints whose pixels are the detectors behind the tracks.

        Args:
            position_mm: centres of the lines of N points on S plates, shape (N, S) [mm].
            sigma_mm: their standard deviations, shape (N, S) [mm].
            track_sr: solid angle through which the line optics collect the light that falls
                on the height of one track, shape (N, S) [sr].
        """
        passed = self.outputs(position_mm, sigma_mm)
        # No light where there is no line, whatever its solid angle says.
        light = np.where(np.isfinite(position_mm), track_sr, 0.0)
        first = np.zeros(position_mm.shape, dtype=np.int64)
        return PixelSolidAngles(first, passed * light[..., None])
