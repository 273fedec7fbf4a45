"""The Warp kernels that make points of readings, one for each number of sensors.

Only ``compute.reconstruction.solver`` imports this module, when a solver is made: it loads Warp.
"""

from functools import cache
from typing import Any, Final

import warp as wp

from compute.reconstruction.native.triangulation import point_source

# Its greeting and its compile times are nothing to a user of ours.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)

OPTIONS: Final = {"enable_backward": False, "fast_math": False}


@cache
def point_kernel(sensors: int, capacity: int) -> Any:
    """Return the kernel for so many sensors, with room for so many terms of distortion.

    It takes the address of a JOB in the device's memory; launch with one thread a point.
    """

    def make_point(number: int, job_address: wp.uint64) -> None: ...

    native = wp.func_native(point_source(sensors, capacity))(make_point)

    def solve_points(job_address: wp.uint64) -> None:
        native(wp.tid(), job_address)

    return wp.kernel(module="unique", module_options=OPTIONS)(solve_points)
