"""Calls of the search: threshold and centre of gravity."""

from typing import Final, Literal

from compute.signal.native.cuda_launch_sizes import (
    BLOCK_PIXELS,
    CANDIDATE_LINES_PER_BATCH,
    SHORT_PIXELS,
)

Length = Literal["block", "short", "long", "any"]
"""Lines of at most BLOCK_PIXELS, of at most SHORT_PIXELS, longer ones, or all: with less to choose
from, the code for CUDA is shorter, which leaves the compiler more registers."""

HEADER_PATH: Final = "compute/signal/native/find_peaks.h"

_NAMES: Final = {"block": "block", "short": "at_most_short", "long": "longer", "any": "any"}


def length_of(pixels: int) -> Length:
    """Return the name of a line's length."""
    return "block" if pixels <= BLOCK_PIXELS else "short" if pixels <= SHORT_PIXELS else "long"


def find_peaks_call(lines_per_batch: int, length: Length) -> str:
    """Return the C++ call of the centroid search, for CUDA and for the CPU.

    The variables are named as the parameters of ``centroid_kernel``.
    """
    return (
        f"lumiline::signal::find_peaks<{lines_per_batch}, "
        f"lumiline::signal::Length::{_NAMES[length]}>("
        "{lines_address, lines, pixels, lines_per_warp, dark_variance_address, "
        "photon_variance_address, offset_address, full_scale_address, sensors, detection_sigma, "
        "fraction_units, weigh_above_threshold, correct_edges, min_width_px, max_peaks, "
        "records_address, record_bytes}, number);"
    )


FIND_PEAKS: Final = find_peaks_call(CANDIDATE_LINES_PER_BATCH, "any")
"""The search that a fit begins with."""
