"""Dark correction: inverted converter counts to counts that increase with light."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hardware.tcd1304.protocol import FIRST_PIXEL, FULL_SCALE, PIXELS, SHIELDED

OFFSET_COUNTS: Final = 64
"""Output count without light: keeps noise below the dark level."""


def dark_level(counts: NDArray[np.uint16]) -> float:
    """Return the dark level: the mean count of the shielded pixels.

    Args:
        counts: what the converter read, shape (3694,).
    """
    return float(counts[SHIELDED].mean())


def dark_corrected_counts(counts: NDArray[np.uint16], saturated_at: int) -> NDArray[np.uint16]:
    """Return the counts of the pixels above the scan's dark level.

    The CCD saturates before the converter ends, at a voltage of its own. Such pixels are set to
    full scale, by which peak detection knows that they are saturated.

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
