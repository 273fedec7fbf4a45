"""The Warp kernels that fit the peaks of line scans, on the CPU and on CUDA.

Only ``compute.signal.fit.fit_finder`` imports this module, when a finder is made: it loads Warp.
"""

from typing import Final

import numpy as np
import warp as wp

from compute.signal.fit.fit_source import FIND_CANDIDATES, FIT_PEAKS_OF_LINE
from compute.signal.peaks import JOINT_PEAKS

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
        ("covariance_px2", "<f4", (JOINT_PEAKS - 1,)),
    ]
)
"""One fitted peak as the kernel writes it."""


def fitted_line_record(max_peaks: int) -> np.dtype[np.void]:
    """Return the type of one line's record: the count, then room for its peaks."""
    return np.dtype([("count", "<i4"), ("spare", "<i4"), ("peaks", FITTED_RECORD, (max_peaks,))])


@wp.func_native(FIND_CANDIDATES)  # type: ignore[untyped-decorator]
def _find_candidates_of_line(
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


@wp.func_native(FIT_PEAKS_OF_LINE)  # type: ignore[untyped-decorator]
def _fit_peaks_of_line(
    line_address: wp.uint64,
    pixels: int,
    sensor: int,
    dark_variance: wp.float64,
    photon_variance: wp.float64,
    offset: wp.float64,
    full_scale: int,
    max_peaks: int,
    plan_address: wp.uint64,
    candidates_address: wp.uint64,
    record_address: wp.uint64,
) -> None: ...


@wp.kernel
def find_candidates(
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
    candidates_address: wp.uint64,
    record_bytes: int,
) -> None:
    """Find the candidates of one line, as ``centroid_kernel.find_peaks`` finds its peaks.

    Each record's spare word is the line's background, in units of 1/LEVEL_UNIT count.
    """
    thread = wp.tid()
    line = thread // lanes  # type: ignore[operator]
    sensor = line % dark_variance.shape[0]
    _find_candidates_of_line(
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
        candidates_address + wp.uint64(line) * wp.uint64(record_bytes),
    )


@wp.kernel
def fit_peaks(
    lines_address: wp.uint64,
    pixels: int,
    dark_variance: wp.array[wp.float64],
    photon_variance: wp.array[wp.float64],
    offset: wp.array[wp.float64],
    full_scale: wp.array[int],
    max_peaks: int,
    plan_address: wp.uint64,
    candidates_address: wp.uint64,
    candidates_bytes: int,
    records_address: wp.uint64,
    record_bytes: int,
) -> None:
    """Fit the candidates of one line; launch with as many threads as lines.

    ``candidates_address`` is that of what ``find_candidates`` wrote, and is written to;
    ``records_address`` that of L records of ``fitted_line_record(max_peaks)``.
    """
    line = wp.tid()
    sensor = line % dark_variance.shape[0]  # type: ignore[operator]
    _fit_peaks_of_line(
        lines_address + wp.uint64(line) * wp.uint64(pixels) * wp.uint64(2),
        pixels,
        sensor,
        dark_variance[sensor],
        photon_variance[sensor],
        offset[sensor],
        full_scale[sensor],
        max_peaks,
        plan_address,
        candidates_address + wp.uint64(line) * wp.uint64(candidates_bytes),
        records_address + wp.uint64(line) * wp.uint64(record_bytes),
    )
