"""Gray-coded plate: transparent and opaque zones in tracks, with a detector behind each."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compute.optics.pixel_solid_angles import PixelSolidAngles, SolidAngleOptics
from compute.parameter_checks import check_positive, require

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GrayPlate:
    """Plate of Mitchelson's instrument: a stripe of light lies across tracks of zones.

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
            require(low <= value <= 12, f"be {low} to 12", **{name: value})
        check_positive(self, "length_mm")

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

    @cached_property
    def transparent(self) -> NDArray[np.bool_]:
        """Mask of the transparent cells by track, shape (cells, tracks)."""
        cell = np.arange(2**self.gray_bits)
        code = cell ^ (cell >> 1)
        gray = (code[:, None] >> np.arange(self.gray_bits - 1, -1, -1)) & 1 == 1
        quarter = cell % 4
        sine, cosine = quarter < 2, (quarter == 0) | (quarter == 3)
        return np.column_stack([gray, sine, ~sine, cosine])


class TrackOptics:
    """Light that the detectors behind a plate's tracks collect, one plate for each sensor.

    Args:
        stripes: optics that image a marker as a stripe on a row of pixels; the pixels are the
            steps of the plate, and as high as a track.
        plate: the plate.
    """

    def __init__(self, stripes: SolidAngleOptics, plate: GrayPlate) -> None:
        self._stripes = stripes
        steps = np.arange(2**plate.bits)
        # By steps, not by cells: a stripe's window begins at any step.
        self._passes = plate.transparent[steps // 2**plate.analogue_bits].astype(np.float64)
        # Two steps of darkness, one at either end, stand for all that falls beside the plate.
        self._passes = np.pad(self._passes, ((1, 1), (0, 0)))

    def solid_angles(self, points_mm: Array) -> PixelSolidAngles:
        """Return the solid angles of points (N, 3) [mm]; the pixels are the detectors."""
        stripes = self._stripes.solid_angles(points_mm)
        window = stripes.solid_angle_sr.shape[2]
        step = stripes.first_px[..., None] + np.arange(window)
        rows = np.clip(step, -1, len(self._passes) - 2) + 1
        collected = np.einsum("nsw,nswt->nst", stripes.solid_angle_sr, self._passes[rows])
        return PixelSolidAngles(np.zeros(stripes.first_px.shape, dtype=np.int64), collected)
