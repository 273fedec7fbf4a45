"""Warp kernels that find the peaks of scans by centre of gravity, on the CPU and on CUDA.

Only ``compute.signal.centroid_finder`` imports this module, when a finder is made: it loads Warp.
"""

from functools import cache
from typing import Any, Final

import warp as wp

from compute.native.headers import module_options
from compute.signal.native.centroid_source import HEADER_PATH, Length, find_peaks_call
from compute.signal.native.cuda_launch_sizes import LAUNCH_BOUNDS, LINES_PER_BATCH

# Without fused multiply-adds, CUDA rounds as the CPU does.
OPTIONS: Final = module_options(HEADER_PATH, fuse_fp=False)


@cache
def centroid_kernel(length: Length) -> Any:
    """Return the kernel for lines of a length on CUDA; on the CPU each takes any line.

    Launch with a thread a line on the CPU (``lanes`` 1); on CUDA with ``lanes`` 32 threads for
    every ``lines_per_warp`` lines, in blocks of BLOCK_THREADS.

    ``lines_address`` is that of uint16 pixels, shape (L, P), the others those of float64, and of
    int32 for full scale, shape (S,); line l is of sensor l % S. ``records_address`` is that of L
    records of ``line_record(max_peaks)``. All are in the device's memory, or in the host's where
    the device reaches it.
    """

    def find_line_peaks(
        number: int,
        lines_address: wp.uint64,
        lines: int,
        pixels: int,
        lines_per_warp: int,
        dark_variance_address: wp.uint64,
        photon_variance_address: wp.uint64,
        offset_address: wp.uint64,
        full_scale_address: wp.uint64,
        sensors: int,
        detection_sigma: wp.float64,
        fraction_units: int,
        weigh_above_threshold: int,
        correct_edges: int,
        min_width_px: int,
        max_peaks: int,
        records_address: wp.uint64,
        record_bytes: int,
    ) -> None: ...

    native = wp.func_native(find_peaks_call(LINES_PER_BATCH, length))(find_line_peaks)

    def find_peaks(
        lanes: int,
        lines_address: wp.uint64,
        lines: int,
        pixels: int,
        lines_per_warp: int,
        dark_variance_address: wp.uint64,
        photon_variance_address: wp.uint64,
        offset_address: wp.uint64,
        full_scale_address: wp.uint64,
        sensors: int,
        detection_sigma: wp.float64,
        fraction_units: int,
        weigh_above_threshold: int,
        correct_edges: int,
        min_width_px: int,
        max_peaks: int,
        records_address: wp.uint64,
        record_bytes: int,
    ) -> None:
        native(
            wp.tid() // lanes,  # type: ignore[operator]
            lines_address,
            lines,
            pixels,
            lines_per_warp,
            dark_variance_address,
            photon_variance_address,
            offset_address,
            full_scale_address,
            sensors,
            detection_sigma,
            fraction_units,
            weigh_above_threshold,
            correct_edges,
            min_width_px,
            max_peaks,
            records_address,
            record_bytes,
        )

    return wp.kernel(module="unique", module_options=OPTIONS, launch_bounds=LAUNCH_BOUNDS)(
        find_peaks
    )
