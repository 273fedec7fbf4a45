"""Warp kernels of the triangulation, one for each number of sensors.

Only ``compute.reconstruction.solver`` imports this module, when a solver is made: it loads Warp.
"""

from functools import cache
from typing import Any

import warp as wp

from compute.native.headers import module_options


@cache
def point_kernel(sensors: int, capacity: int) -> Any:
    """Return the kernel for a number of sensors.

    It takes the address of a JOB in the device's memory; launch with one thread a point.

    Args:
        sensors: number of sensors S.
        capacity: largest number of terms of distortion.
    """

    def make_point(number: int, job_address: wp.uint64) -> None: ...

    native = wp.func_native(f"lumiline::solve_point<{sensors}, {capacity}>(number, job_address);")(
        make_point
    )

    def solve_points(job_address: wp.uint64) -> None:
        native(wp.tid(), job_address)

    options = module_options("compute/reconstruction/native/triangulation.h")
    return wp.kernel(module="unique", module_options=options)(solve_points)
