"""The Warp kernel that finds the peaks of line scans, on the CPU and on CUDA.

Only ``compute.signal.finder`` imports this module, when a finder is made: it loads Warp.

On the CPU one thread takes a line; on CUDA the 32 lanes of a warp take it.
"""

from typing import Final

import numpy as np
import warp as wp

from compute.signal.centroid_source import FIND_PEAKS_OF_LINE

# Its greeting and its compile times are nothing to a user of ours.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
# Without fused multiply-adds, CUDA rounds as the CPU does.
wp.set_module_options({"enable_backward": False, "fast_math": False, "fuse_fp": False})

CUDA_LANES: Final = 32
"""Threads that share a line on CUDA: the size of a warp."""

PEAK_RECORD: Final = np.dtype(
    [
        ("position_px", "<f8"),
        ("sigma_px", "<f4"),
        ("amplitude", "<f4"),
        ("width_px", "<f4"),
        ("flags", "<i4"),
    ]
)
"""One peak as the kernel writes it."""


def line_record(max_peaks: int) -> np.dtype[np.void]:
    """Return the type of one line's record: the count, then room for its peaks."""
    return np.dtype([("count", "<i4"), ("spare", "<i4"), ("peaks", PEAK_RECORD, (max_peaks,))])


@wp.func_native(FIND_PEAKS_OF_LINE)  # type: ignore[untyped-decorator]
def _find_peaks_of_line(
    line_address: wp.uint64,
    pixels: int,
    lane: int,
    dark_variance: wp.float64,
    photon_variance: wp.float64,
    offset: wp.float64,
    full_scale: int,
    detection_sigma: wp.float64,
    fraction_units: int,
    weigh_above_threshold: int,
    correct_edges: int,
    min_width_px: int,
    max_peaks: int,
    record_address: wp.uint64,
) -> None: ...


@wp.kernel
def find_peaks(
    lines_address: wp.uint64,
    pixels: int,
    lanes: int,
    dark_variance: wp.array[wp.float64],
    photon_variance: wp.array[wp.float64],
    offset: wp.array[wp.float64],
    full_scale: wp.array[int],
    detection_sigma: wp.float64,
    fraction_units: int,
    weigh_above_threshold: int,
    correct_edges: int,
    min_width_px: int,
    max_peaks: int,
    records_address: wp.uint64,
    record_bytes: int,
) -> None:
    """Find the peaks of one line; launch with ``lines * lanes`` threads, blocks of whole warps.

    ``lines_address`` is that of uint16 pixels, shape (L, P), in the device's memory;
    ``records_address`` that of L records of ``line_record(max_peaks)``.
    """
    thread = wp.tid()
    line = thread // lanes  # type: ignore[operator]
    sensor = line % dark_variance.shape[0]
    _find_peaks_of_line(
        lines_address + wp.uint64(line) * wp.uint64(pixels) * wp.uint64(2),
        pixels,
        thread % lanes,  # type: ignore[operator]
        dark_variance[sensor],
        photon_variance[sensor],
        offset[sensor],
        full_scale[sensor],
        detection_sigma,
        fraction_units,
        weigh_above_threshold,
        correct_edges,
        min_width_px,
        max_peaks,
        records_address + wp.uint64(line) * wp.uint64(record_bytes),
    )
