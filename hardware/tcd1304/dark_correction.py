"""From the converter's counts, high where it is dark, to counts that grow with the light."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hardware.tcd1304.protocol import FIRST_PIXEL, FULL_SCALE, PIXELS, SHIELDED

OFFSET_COUNTS: Final = 64
"""The count without light: room for noise below the dark level."""


def dark_level(counts: NDArray[np.uint16]) -> float:
    """Return what the pixels under the light shield show.

    Args:
        counts: what the converter read, shape (3694,).
    """
    return float(counts[SHIELDED].mean())


def dark_corrected_counts(counts: NDArray[np.uint16], saturated_at: int) -> NDArray[np.uint16]:
    """Return the pixels' light above the line's own dark level.

    The CCD saturates before the converter ends, at a voltage of its own. Such pixels are set to
    full scale, which is what tells the finding of peaks that they are saturated.

    Args:
        counts: what the converter read, shape (3694,).
        saturated_at: the count at which, and below, a pixel is full.

    Returns:
        Counts, uint16, shape (3648,): OFFSET_COUNTS without light, 4095 where full.
    """
    pixels = counts[FIRST_PIXEL : FIRST_PIXEL + PIXELS]
    dark = round(dark_level(counts)) + OFFSET_COUNTS
    light = np.clip(dark - pixels.astype(np.int32), 0, FULL_SCALE)
    light[pixels <= saturated_at] = FULL_SCALE
    return light.astype(np.uint16)
