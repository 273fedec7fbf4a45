"""Warp kernels of the strobed step, one for each number of sensors.

Only ``compute.pose.filtering.native.strobed_step`` imports this module, when a kernel is made: it
loads Warp.
"""

from functools import cache
from typing import Any

import warp as wp

from compute.native.headers import module_options


@cache
def step_kernel(sensors: int, room: int) -> Any:
    """Return the strobed-step kernel; it takes the address of a STEP.

    Launch it with one thread, on the CPU.

    Args:
        sensors: number of sensors.
        room: largest number of distortion terms.
    """

    def take_step(step_address: wp.uint64) -> None: ...

    native = wp.func_native(f"lumiline::pose::take_step<{sensors}, {room}>(step_address);")(
        take_step
    )

    def strobed_step(step_address: wp.uint64) -> None:
        native(step_address)

    options = module_options("compute/pose/filtering/native/strobed_step.h")
    return wp.kernel(module="unique", module_options=options)(strobed_step)
