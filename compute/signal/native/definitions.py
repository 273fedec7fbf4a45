"""Definitions that the search in C++ shares with Python: constants, launches, peak records."""

from typing import Final

import numpy as np

from compute.native.records import Record, constants, header
from compute.signal.centroid_settings import FRACTION_UNIT, GROUP_PIXELS, LEVEL_UNIT, SAMPLE_GROUPS
from compute.signal.peaks import PeakFlag

BLOCK_THREADS: Final = 64
BLOCK_PIXELS: Final = 2048
SCANS_PER_BATCH: Final = 4
"""Scans of a block that a warp takes together, at most 4. With eight peaks each, every lane has
one. Of longer scans it takes fewer, down to one of as many blocks."""
SHORT_PIXELS: Final = SCANS_PER_BATCH * BLOCK_PIXELS
"""Scans up to this length are brought to shared memory whole."""
LAUNCH_BOUNDS: Final = (BLOCK_THREADS, 6)
"""Blocks that fit in shared memory, by their number of scans."""
LONG_SCANS_PER_WARP: Final = 2
"""Longer scans of a warp: the second one's blocks come while the first one's peaks are measured."""
CANDIDATE_SCANS_PER_BATCH: Final = 2
"""SCANS_PER_BATCH where a fit follows: what shared memory leaves is cache, and that holds the fit's
arrays."""
FIT_SCANS_PER_WARP: Final = 32
"""Scans that a warp searches, batch after batch, before it fits: so that most lanes have a group,
even of scans with one peak."""
FIT_LAUNCH_BOUNDS: Final = (BLOCK_THREADS, 512 // BLOCK_THREADS)
"""128 registers a thread: the fit of one peak keeps its sums in them."""

PEAK_FIELDS: Final = {
    "position_px": "double",
    "sigma_px": "float",
    "amplitude": "float",
    "width_px": "float",
    "flags": "int",
}
PEAK: Final = Record("PeakRecord", PEAK_FIELDS)

SENSOR_CORRECTION: Final = Record(
    "SensorCorrection",
    {
        "offset": "float",
        "first_bend": "float",
        "second_bend": "float",
        "group_shifts": f"int[{SAMPLE_GROUPS}]",
        "padding": "int",
    },
)
"""What is the same for a calibrated sensor's pixels: mean offset, coefficients of nonlinearity, and
how far the offsets of the background's groups lie above it, summed over a group [counts]. Behind
them the pixels' records lie on boundaries of 8 bytes."""

PIXEL_CORRECTION: Final = Record("PixelCorrection", {"dark": "float", "scale": "float"})
"""A pixel's count without light, and the reciprocal of its response: 0 where it is masked."""

RAMP_UNIT: Final = 4096
"""A background's slope is an integer in units of 1/4096 count per pixel."""


def scan_record(max_peaks: int) -> np.dtype[np.void]:
    """Return the type of one scan's record: count, background [1/64 count], room for peaks."""
    head = [("count", "<i4"), ("background", "<i4")]
    return np.dtype([*head, ("peaks", PEAK.dtype, (max_peaks,))])


HEADER: Final = header(
    "lumiline::signal",
    PEAK.source,
    SENSOR_CORRECTION.source,
    PIXEL_CORRECTION.source,
    constants(
        {
            "level_unit": LEVEL_UNIT,
            "fraction_unit": FRACTION_UNIT,
            "group_pixels": GROUP_PIXELS,
            "sample_groups": SAMPLE_GROUPS,
            "no_key": 0x7FFFFFFF,
            "ramp_unit": RAMP_UNIT,
            "block_threads": BLOCK_THREADS,
            "block_pixels": BLOCK_PIXELS,
            "scans_per_batch": SCANS_PER_BATCH,
            "candidate_scans_per_batch": CANDIDATE_SCANS_PER_BATCH,
            "flag_saturated": PeakFlag.SATURATED,
            "flag_clipped": PeakFlag.CLIPPED,
            "flag_merged": PeakFlag.MERGED,
            "flag_truncated": PeakFlag.TRUNCATED,
        }
    ),
)
