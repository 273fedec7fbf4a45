"""The records that the search writes: one line's, with its peaks."""

from typing import Final

import numpy as np

from compute.native.records import Record

PEAK: Final = Record(
    "PeakRecord",
    {
        "position_px": "double",
        "sigma_px": "float",
        "amplitude": "float",
        "width_px": "float",
        "flags": "int",
    },
)
PEAK_RECORD: Final = PEAK.dtype
"""One peak as the kernel writes it."""


def line_record(max_peaks: int) -> np.dtype[np.void]:
    """Return the type of one line's record: count, background [1/64 count], room for peaks."""
    head = [("count", "<i4"), ("background", "<i4")]
    return np.dtype([*head, ("peaks", PEAK_RECORD, (max_peaks,))])
