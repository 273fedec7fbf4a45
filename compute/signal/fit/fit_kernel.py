"""The Warp kernel that fits the peaks of line scans, on the CPU and on CUDA.

Only ``compute.signal.fit.fit_finder`` imports this module, when a finder is made: it loads Warp.
"""

from typing import Final

import numpy as np
import warp as wp

from compute.signal.fit.fit_source import FIT_PEAKS
from compute.signal.native.centroid_source import FIND_PEAKS
from compute.signal.native.cuda_launch_sizes import FIT_LAUNCH_BOUNDS
from compute.signal.native.peak_record import line_record
from compute.signal.peaks import MAX_JOINT_PEAKS

# Its greeting and its compile times are nothing to a user of ours.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
# Without fused multiply-adds, CUDA rounds as the CPU does.
wp.set_module_options({"enable_backward": False, "fast_math": False, "fuse_fp": False})

FITTED_RECORD: Final = np.dtype(
    [
        ("position_px", "<f8"),
        ("sigma_px", "<f4"),
        ("amplitude", "<f4"),
        ("width_px", "<f4"),
        ("flags", "<i4"),
        ("reduced_chi2", "<f4"),
        ("covariance_px2", "<f4", (MAX_JOINT_PEAKS - 1,)),
    ]
)
"""One fitted peak as the kernel writes it."""


def fitted_line_record(max_peaks: int) -> np.dtype[np.void]:
    """Return the type of one line's record: fitted peaks, then the candidates of the search."""
    return np.dtype(
        [
            ("count", "<i4"),
            ("truncated", "<i4"),
            ("peaks", FITTED_RECORD, (max_peaks,)),
            ("candidates", line_record(max_peaks)),
        ]
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


@wp.func_native(FIT_PEAKS)  # type: ignore[untyped-decorator]
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
