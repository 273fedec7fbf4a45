"""Warp kernels that find the peaks of scans, by centre of gravity or fit, on the CPU and on CUDA.

Only a finder imports this module, when it is made: it loads Warp.
"""

from functools import cache
from typing import Any, Final, Literal

import warp as wp

from compute.native.headers import module_options
from compute.signal.native.definitions import FIT_LAUNCH_BOUNDS, LAUNCH_BOUNDS

Search = Literal["block", "at_most_short", "longer", "fit"]
"""Centres of gravity in scans of at most BLOCK_PIXELS, of at most SHORT_PIXELS, or of longer ones,
on the CPU in scans of any length; or the fit, for any length."""

_SEARCH: Final = (
    "lumiline::signal::search_of(batch, scans_address, scans, scans_per_warp, records_address)"
)


@wp.struct
class ScanBatch:
    """Arguments that all launches share; ``search_of`` in search.h reads them.

    Noise arrays have the shape (S,); scan l is of sensor l % S. ``corrections_address`` is that of
    what ``PixelCorrections.pack`` packs, or 0. ``plan_address`` is that of what ``pack_plan``
    packs, and ``candidates_offset`` where the candidates begin in a scan's record; both are of the
    fit. ``lanes`` threads take ``scans_per_warp`` scans together: 1 on the CPU.
    """

    lanes: int
    pixels: int
    sensors: int
    record_bytes: int
    dark_variance: wp.array(dtype=wp.float64)  # type: ignore[valid-type]
    photon_variance: wp.array(dtype=wp.float64)  # type: ignore[valid-type]
    offset_counts: wp.array(dtype=wp.float64)  # type: ignore[valid-type]
    full_scale_counts: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    detection_sigma: wp.float64
    fraction_units: int
    weigh_above_threshold: int
    correct_edges: int
    min_width_px: int
    max_peaks: int
    corrections_address: wp.uint64
    plan_address: wp.uint64
    candidates_offset: int


@cache
def scan_kernel(search: Search, corrected: bool) -> Any:
    """Return the kernel of a search in scans with or without a calibration.

    Launch on the CPU with a thread a scan, on CUDA with 32 for every ``scans_per_warp`` scans, in
    blocks of BLOCK_THREADS. ``scans_address`` is that of uint16 pixels, shape (L, P),
    ``records_address`` that of L records: in the device's memory, or in the host's where the
    device reaches it.

    Args:
        search: which kernel.
        corrected: whether the scans' sensors have a radiometric calibration.
    """
    flag = "true" if corrected else "false"
    if search == "fit":
        path, bounds = "compute/signal/fit/native/fit_peaks.h", FIT_LAUNCH_BOUNDS
        call = f"fit_peaks<{flag}>({_SEARCH}, batch.plan_address, batch.candidates_offset, number);"
    else:
        path, bounds = "compute/signal/native/find_peaks.h", LAUNCH_BOUNDS
        call = (
            "find_peaks<lumiline::signal::scans_per_batch, "
            f"lumiline::signal::Length::{search}, {flag}>({_SEARCH}, number);"
        )

    @wp.func_native(f"lumiline::signal::{call}")  # type: ignore[untyped-decorator]
    def native_search(
        number: int,
        scans_address: wp.uint64,
        scans: int,
        scans_per_warp: int,
        records_address: wp.uint64,
        batch: ScanBatch,
    ) -> None: ...

    def find_peaks(
        scans_address: wp.uint64,
        scans: int,
        scans_per_warp: int,
        records_address: wp.uint64,
        batch: ScanBatch,
    ) -> None:
        native_search(
            wp.tid() // batch.lanes,  # type: ignore[operator]
            scans_address,
            scans,
            scans_per_warp,
            records_address,
            batch,
        )

    # Without fused multiply-adds, CUDA rounds as the CPU does.
    options = module_options(path, fuse_fp=False)
    return wp.kernel(module="unique", module_options=options, launch_bounds=bounds)(find_peaks)
