"""Warp kernels of the association of peaks with tracks, one for each number of sensors.

Only ``compute.tracking.native.associator`` imports this module, when it is made: it loads Warp.
"""

from functools import cache
from typing import Any

import warp as wp

from compute.native.headers import module_options


@cache
def association_kernel(sensors: int, room: int) -> Any:
    """Return the kernel for a number of sensors.

    Args:
        sensors: number of sensors S.
        room: largest number of terms of distortion.
    """

    def associate_frame(job_address: wp.uint64) -> None: ...

    native = wp.func_native(
        f"lumiline::tracking::associate_frame<{sensors}, {room}>(job_address);"
    )(associate_frame)

    def associate_peaks(job_address: wp.uint64) -> None:
        native(job_address)

    options = module_options("compute/tracking/native/association.h")
    return wp.kernel(module="unique", module_options=options)(associate_peaks)
