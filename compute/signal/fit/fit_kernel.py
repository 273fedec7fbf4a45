"""Warp kernel that fits the peaks of scans, on the CPU and on CUDA.

Only ``compute.signal.fit.fit_finder`` imports this module, when a finder is made: it loads Warp.
"""

from typing import Final

import warp as wp

from compute.native.headers import module_options
from compute.signal.native.centroid_source import FIND_PEAKS
from compute.signal.native.cuda_launch_sizes import FIT_LAUNCH_BOUNDS

# Without fused multiply-adds, CUDA rounds as the CPU does.
wp.set_module_options(module_options("compute/signal/fit/native/fit_peaks.h", fuse_fp=False))

_FIT_PEAKS: Final = (
    "lumiline::signal::fit_peaks({lines_address, lines, pixels, lines_per_warp, "
    "dark_variance_address, photon_variance_address, offset_address, full_scale_address, "
    "sensors, max_peaks, plan_address, records_address, record_bytes}, number);"
)


@wp.func_native(FIND_PEAKS)  # type: ignore[untyped-decorator]
def _find_candidates(
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


@wp.func_native(_FIT_PEAKS)  # type: ignore[untyped-decorator]
def _fit_peaks(
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
    max_peaks: int,
    plan_address: wp.uint64,
    records_address: wp.uint64,
    record_bytes: int,
) -> None: ...


@wp.kernel(launch_bounds=FIT_LAUNCH_BOUNDS)  # type: ignore[untyped-decorator]
def fit_peaks(
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
    plan_address: wp.uint64,
    candidates_offset: int,
    records_address: wp.uint64,
    record_bytes: int,
) -> None:
    """Find the candidates of lines and fit them; launched as ``find_peaks`` is.

    ``plan_address`` is that of what ``pack_plan`` packs, ``records_address`` that of L records of
    ``fitted_line_record(max_peaks)``, in which candidates begin at ``candidates_offset``.
    """
    number = wp.tid() // lanes  # type: ignore[operator]
    _find_candidates(
        number,
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
        records_address + wp.uint64(candidates_offset),
        record_bytes,
    )
    _fit_peaks(
        number,
        lines_address,
        lines,
        pixels,
        lines_per_warp,
        dark_variance_address,
        photon_variance_address,
        offset_address,
        full_scale_address,
        sensors,
        max_peaks,
        plan_address,
        records_address,
        record_bytes,
    )
