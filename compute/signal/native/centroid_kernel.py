"""The Warp kernel that finds the peaks of line scans, on the CPU and on CUDA.

Only ``compute.signal.finder`` imports this module, when a finder is made: it loads Warp.
"""

import warp as wp

from compute.signal.native.centroid import FIND_CENTROIDS
from compute.signal.native.cuda_sizes import LAUNCH_BOUNDS

# Its greeting and its compile times are nothing to a user of ours.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
# Without fused multiply-adds, CUDA rounds as the CPU does.
wp.set_module_options({"enable_backward": False, "fast_math": False, "fuse_fp": False})


@wp.func_native(FIND_CENTROIDS)  # type: ignore[untyped-decorator]
def _find_peaks(
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


@wp.kernel(launch_bounds=LAUNCH_BOUNDS)  # type: ignore[untyped-decorator]
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
    """Find the peaks of lines.

    Launch with a thread a line on the CPU (``lanes`` 1); on CUDA with ``lanes`` 32 threads for
    every ``lines_per_warp`` lines, in blocks of BLOCK_THREADS.

    ``lines_address`` is that of uint16 pixels, shape (L, P), the others those of float64, and of
    int32 for full scale, shape (S,); line l is of sensor l % S. ``records_address`` is that of L
    records of ``line_record(max_peaks)``. All are in the device's memory, or in the host's where
    the device reaches it.
    """
    _find_peaks(
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
