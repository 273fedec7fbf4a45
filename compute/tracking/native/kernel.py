"""The Warp kernels that associate peaks with tracks, one for each number of sensors.

Only ``compute.tracking.native.associator`` imports this module, when it is made: it loads Warp.
"""

from functools import cache
from typing import Any, Final

import warp as wp

from compute.tracking.native.association import association_source

# Its greeting and its compile times are nothing to a user of ours.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)

OPTIONS: Final = {"enable_backward": False, "fast_math": False}


@cache
def association_kernel(sensors: int, room: int) -> Any:
    """Return the kernel for so many sensors, with room for so many terms of distortion."""

    def associate_frame(job_address: wp.uint64) -> None: ...

    native = wp.func_native(association_source(sensors, room))(associate_frame)

    def associate_peaks(job_address: wp.uint64) -> None:
        native(job_address)

    return wp.kernel(module="unique", module_options=OPTIONS)(associate_peaks)
