"""Constants and the peak record of the search, for C++."""

from typing import Final

from compute.native.records import constants, header
from compute.signal.centroid_settings import FRACTION_UNIT, GROUP_PIXELS, LEVEL_UNIT, SAMPLE_GROUPS
from compute.signal.native.cuda_launch_sizes import BLOCK_PIXELS, BLOCK_THREADS
from compute.signal.native.peak_record import PEAK
from compute.signal.peaks import PeakFlag

HEADER: Final = header(
    "lumiline::signal",
    PEAK.source,
    constants(
        {
            "level_unit": LEVEL_UNIT,
            "fraction_unit": FRACTION_UNIT,
            "group_pixels": GROUP_PIXELS,
            "sample_groups": SAMPLE_GROUPS,
            "no_key": 0x7FFFFFFF,
            "block_threads": BLOCK_THREADS,
            "block_pixels": BLOCK_PIXELS,
            "flag_saturated": PeakFlag.SATURATED,
            "flag_clipped": PeakFlag.CLIPPED,
            "flag_merged": PeakFlag.MERGED,
            "flag_truncated": PeakFlag.TRUNCATED,
        }
    ),
)
